"""One module for each question; it registers an `Experiment`, and is imported when that is looked up."""

from foretrace.evaluation.experiment import EXPERIMENTS, SUMMARIES

__all__ = ["EXPERIMENTS", "SUMMARIES"]
