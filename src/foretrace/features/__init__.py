"""Features of an object from its view: the paper's descriptors (section 3)."""

from foretrace.features.autoencoder import Autoencoder256, Autoencoder512
from foretrace.features.base import (
    FEATURES,
    FeatureExtractor,
    FitPart,
    NoFeatures,
    Option,
    Precision,
    TracedFeatures,
    make_features,
)
from foretrace.features.cnn import ImageCnn, ShapeContextCnn
from foretrace.features.outline import Outline
from foretrace.features.pivot_edges import PivotEdgeFeatures
from foretrace.features.shape_context import ShapeContext200, ShapeContext800, ShapeContext3200
from foretrace.features.support_points import (
    ObservedSupportPoints,
    PredictedSupportPoints,
    SupportPointsByRule,
    support_point_accuracy,
)

FEATURES.arrange(
    (
        *("none", "im-cnn", "sc-cnn", "sc-200", "sc-800", "sc-3200"),
        *("ae-256", "ae-512", "sp-rule", "sp-pred", "sp-truth", "outline", "pivot-edge"),
    )
)

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
    "PivotEdgeFeatures",
    "Precision",
    "PredictedSupportPoints",
    "ShapeContext200",
    "ShapeContext800",
    "ShapeContext3200",
    "ShapeContextCnn",
    "SupportPointsByRule",
    "TracedFeatures",
    "make_features",
    "support_point_accuracy",
]
