"""Interactions, simulated or recorded: what was seen, what was done, what happened; and their storage."""
