"""One module for each question that is put to predictors; each registers an `Experiment`, and is imported when needed."""

from foretrace.evaluation.experiment import EXPERIMENTS

SUMMARIES = {
    "predictor": "Errors of one trained predictor, over the full trajectory and at its end.",
    "paper": "The paper's comparisons of features, training sizes, steps ahead and novel shapes.",
    "randomisation": "What randomised training data do for transfer, and what it helps to know what was drawn.",
    "reconstruction": "What the codes of autoencoders retain of masks.",
    "replay": "How far simulated motions of rigid bodies stray from recorded ones.",
    "transfer": "Predictions against recorded lever-ups, or against a stand-in for the real robot.",
    "non-flat": "Masks against height maps of objects that are not flat.",
    "uncertainty": "How far to trust probabilities, regions and samples of a predictor of several futures.",
}
"""What comes with foretrace, each in a line."""
for _label in SUMMARIES:
    EXPERIMENTS.declare(_label, f"foretrace.experiments.{_label.replace('-', '_')}")

__all__ = ["EXPERIMENTS", "SUMMARIES"]
