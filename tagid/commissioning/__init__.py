"""From an unpacked radar to a rig that is trusted: steps that measure, each with its standard error."""
