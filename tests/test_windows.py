import pytest
import torch
from torch import nn

from foretrace.features.windows import convolve_windows, crop, find_windows, paste


@pytest.fixture(scope="module")
def images():
    """An object at the right rim, one in the middle, one too wide for a window, nothing, and everything."""
    torch.manual_seed(0)
    images = torch.zeros(5, 1, 128, 128)  # whole numbers, whose sums are exact
    images[0, 0, 33:96, 100:128] = torch.randint(1, 9, (63, 28)).float()
    images[1, 0, 40:96, 30:90] = torch.randint(1, 9, (56, 60)).float()
    images[2, 0, 60:70, 5:125] = 1
    images[4] = 1
    return images


def test_every_image_has_one_window_and_the_object_is_in_it(images):
    parts = find_windows(images)
    assert sorted(torch.cat([part[0] for part in parts]).tolist()) == [0, 1, 2, 3, 4]
    shapes = {tuple(part[0].tolist()): crop(images, part).shape[1:] for part in parts}
    assert shapes == {(0, 1): (1, 64, 80), (2, 3, 4): (1, 128, 128)}
    for part in parts:
        assert torch.equal(crop(images, part).sum((1, 2, 3)), images[part[0]].sum((1, 2, 3)))


def test_what_was_cropped_can_be_put_back(images):
    copy = torch.zeros_like(images)
    for part in find_windows(images):
        paste(copy, part, crop(images, part))
    assert torch.equal(copy, images)


def test_maps_are_those_of_the_window_and_zero_beside_it(images):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(1, 3, 3, padding=1), nn.MaxPool2d(16))
    maps = convolve_windows(images, network, channels=3)
    assert maps.shape == (5, 3, 8, 8)
    with torch.no_grad():
        torch.testing.assert_close(maps[1, :, 2:6, 1:6], network(images[1:2, :, 32:96, 16:96])[0])
        torch.testing.assert_close(maps[2:3], network(images[2:3]))
    assert maps[1, :, :2].abs().max() == 0
    assert maps[1, :, 2:6, 1:6].abs().min() > 0


def test_an_image_does_not_depend_on_its_neighbours(images):
    network = nn.Sequential(nn.Conv2d(1, 2, 3, padding=1), nn.MaxPool2d(16))
    together = convolve_windows(images, network, channels=2)
    alone = torch.cat([convolve_windows(image[None], network, channels=2) for image in images])
    torch.testing.assert_close(together, alone)


def test_gradients_flow_through_windows(images):
    network = nn.Sequential(nn.Conv2d(1, 2, 3, padding=1), nn.MaxPool2d(16))
    convolve_windows(images, network, channels=2).sum().backward()
    assert network[0].weight.grad is not None
    assert network[0].weight.grad.abs().sum() > 0
