"""What the predictor is told about an object: the paper's feature descriptors (section 3)."""

from foretrace.errors import TrainingError
from foretrace.features.autoencoder import Autoencoder256, Autoencoder512
from foretrace.features.base import FeatureExtractor, FitPart, NoFeatures, Option, Precision, option_names
from foretrace.features.cnn import ImageCnn, ShapeContextCnn
from foretrace.features.outline import Outline
from foretrace.features.shape_context import ShapeContext200, ShapeContext800, ShapeContext3200
from foretrace.features.support_points import (
    ObservedSupportPoints,
    PredictedSupportPoints,
    SupportPointsByRule,
    support_point_accuracy,
)

FEATURES: dict[str, type[FeatureExtractor]] = {
    extractor.label: extractor
    for extractor in (
        *(NoFeatures, ImageCnn, ShapeContextCnn),
        *(ShapeContext200, ShapeContext800, ShapeContext3200),
        *(Autoencoder256, Autoencoder512),
        *(SupportPointsByRule, PredictedSupportPoints, ObservedSupportPoints),
        Outline,
    )
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
    "Autoencoder256",
    "Autoencoder512",
    "FeatureExtractor",
    "FitPart",
    "ImageCnn",
    "NoFeatures",
    "ObservedSupportPoints",
    "Option",
    "Outline",
    "Precision",
    "PredictedSupportPoints",
    "ShapeContext200",
    "ShapeContext800",
    "ShapeContext3200",
    "ShapeContextCnn",
    "SupportPointsByRule",
    "make_features",
    "support_point_accuracy",
]
