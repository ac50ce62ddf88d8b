"""What the predictor is told about an object: the paper's feature descriptors (section 3)."""

from foretrace.errors import TrainingError
from foretrace.features.base import FeatureExtractor, FitPart, NoFeatures, Option, Precision, option_names
from foretrace.features.cnn import ImageCnn

FEATURES: dict[str, type[FeatureExtractor]] = {
    extractor.label: extractor for extractor in (NoFeatures, ImageCnn)
}
"""Every feature extractor by its label in the paper's figures."""


def make_features(label: str, **options: Option) -> FeatureExtractor:
    """Make a feature extractor by its label.

    Args:
        label: A key of ``FEATURES``.
        **options: Settings of that extractor's constructor.

    Raises:
        TrainingError: The label or an option is unknown.
    """
    if label not in FEATURES:
        raise TrainingError(f"unknown features {label!r}; available: {', '.join(FEATURES)}")
    known = option_names(FEATURES[label])
    for name in options:
        if name not in known:
            raise TrainingError(f"{label} has no option {name!r}; it has: {', '.join(known) or 'none'}")
    return FEATURES[label](**options)


__all__ = [
    "FEATURES",
    "FeatureExtractor",
    "FitPart",
    "ImageCnn",
    "NoFeatures",
    "Option",
    "Precision",
    "make_features",
]
