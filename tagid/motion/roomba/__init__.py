"""A floor robot as a turntable; opcodes and packets are those of iRobot's "Create 2 Open Interface (OI)
Specification"."""
