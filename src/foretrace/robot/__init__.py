"""Lever-ups by a real UR10: planned, checked, then executed. It has never moved a real arm."""
