"""The way out: interactions, and what was imagined about them, in the formats of other tools."""
