"""What a study can find, simulated before it is played."""
