"""From a recording to an answer, one way for all: commands, reports, the station and programs."""
