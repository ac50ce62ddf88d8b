"""A feature of one's own: area, length and width of the object as seen from above.

Defining the class registers it by its label, for every predictor.

python examples/own_feature.py data runs/extent
"""

import sys

import torch

import foretrace as ft
from foretrace.predictor import TrainConfig


class Extent(ft.FeatureExtractor):
    """Area, length along the action and width across it, each of about unit scale.

    Args:
        with_area: Whether the area is one of the features.
    """

    label = "extent"

    def __init__(self, with_area: bool = True):
        super().__init__(with_area=with_area)  # options that a checkpoint has to keep
        self.with_area = with_area

    @property
    def num_features(self) -> int:
        """Length of the feature vector."""
        return 2 + self.with_area

    def inputs(self, batch):
        """What is read of the views, once for each data set: nothing learned, nothing random."""
        mask = torch.from_numpy(batch.mask).float()  # (batch, 128, 128)
        sizes = [mask.amax(dim=2).sum(dim=1), mask.amax(dim=1).sum(dim=1)]
        if self.with_area:
            sizes.append(mask.sum(dim=(1, 2)).sqrt())
        return torch.stack(sizes, dim=1)

    def forward(self, inputs):
        """The features; layers with parameters here would be trained with the predictor."""
        return inputs / 30 - 1


if __name__ == "__main__":
    config = ft.LstmConfig(features="extent", feature_options={"with_area": False}, hidden=32)
    training = TrainConfig(epochs=5, min_steps=50, split=None)
    run = ft.train_predictor(ft.Dataset.open(sys.argv[1]), config, sys.argv[2], training, progress=False)
    predictor = ft.load_predictor(run)
    box = ft.Box(0.15, 0.13, 0.02)
    view = ft.TopDownView.of(box, ft.LeverUp.at_edge(box, edge=0))
    end = predictor.imagine(view).com_trajectory[-1]
    print(f"{predictor.display_name}: the centre of mass ends at {end.round(3).tolist()} m")
