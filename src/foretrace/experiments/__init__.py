"""Experiments: one file a question; each plans trials, runs one, and reads tables and figures off the rows."""
