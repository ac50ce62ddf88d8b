"""Convolving only where an object is: most of a view is blank table."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

CELL = 16
"""Pixels a side that four 2x2 poolings make into one cell of a feature map."""
WINDOW = (4, 5)
"""Rows and columns of cells that hold most objects: up to 20 cm ahead of the contact point, 26 cm across."""

Part = tuple[Int[Tensor, " images"], Int[Tensor, "images rows"], Int[Tensor, "images columns"]]
"""Some images by number, and the rows and columns of cells of each one's window."""


def find_windows(images: Shaped[Tensor, "batch 1 height width"]) -> list[Part]:
    """The cells of every image that are worth looking at, images with windows of one size together.

    An image's window is the whole image unless everything that is not 0 lies within ``WINDOW`` cells: then it is
    those, which costs a third. It depends on the image alone, not on the others; a blank one is looked at whole.

    Args:
        images: Views, 0 where no object is, of some multiple of ``CELL`` pixels in height and width.

    Returns:
        One or two parts, which have every image once.
    """
    fits, corner, size = _find(images)
    small = _window_size(size)
    parts = []
    for chosen, extent in ((fits, small), (~fits, size)):
        index = chosen.nonzero()[:, 0]
        if len(index):
            parts.append(
                (index, *(_cells(c[index], n, m) for c, n, m in zip(corner, extent, size, strict=True)))
            )
    return parts


def crop(images: Shaped[Tensor, "batch 1 height width"], part: Part) -> Shaped[Tensor, "images 1 h w"]:
    """The windows of some images."""
    return images[_places(part, CELL)].permute(0, 3, 1, 2)


def paste(
    images: Shaped[Tensor, "batch channels height width"],
    part: Part,
    windows: Shaped[Tensor, "images channels h w"],
) -> None:
    """Put windows back into whole images, or into maps of one pixel per cell."""
    scale = windows.shape[2] // part[1].shape[1]
    images[_places(part, scale)] = windows.permute(0, 2, 3, 1)


def convolve_windows(
    images: Shaped[Tensor, "batch 1 height width"], network: Callable[[Tensor], Tensor], channels: int
) -> Shaped[Tensor, "batch {channels} rows columns"]:
    """Feature maps of whole images of which a network sees the windows only; the cells outside are 0.

    Args:
        images: Views, 0 where no object is.
        network: From images of any size to maps of one cell per ``CELL`` pixels.
        channels: Channels of those maps.
    """
    size = images.shape[2] // CELL, images.shape[3] // CELL
    maps = torch.zeros(len(images), channels, *size, device=images.device)
    for part in find_windows(images):
        paste(maps, part, network(crop(images, part).float()).float())
    return maps


def convolve_unbranched(
    images: Shaped[Tensor, "batch 1 height width"], network: Callable[[Tensor], Tensor]
) -> Shaped[Tensor, "batch channels rows columns"]:
    """The maps of `convolve_windows` from the same operations for every image, as a graph in a file must have them.

    Every image is convolved twice, whole and in its window, and one of the two is kept.
    """
    fits, (top, left), size = _find(images)
    rows, columns = _window_size(size)
    index = torch.arange(images.shape[0], device=images.device)
    part = index, _cells(top, rows, size[0]), _cells(left, columns, size[1])
    maps = network(crop(images, part))
    # The windows' cells at their places: each cell of the whole map looks up where it lies in the window.
    for dim, first, count in ((2, part[1][:, :1], rows), (3, part[2][:, :1], columns)):
        place = torch.arange(size[dim - 2], device=images.device) - first  # (batch, cells)
        place = place[:, None, :, None] if dim == 2 else place[:, None, None]
        shape = [*maps.shape[:dim], size[dim - 2], *maps.shape[dim + 1 :]]
        found = maps.gather(dim, place.clamp(0, count - 1).expand(shape))
        maps = torch.where((place >= 0) & (place < count), found, 0.0)
    return torch.where(fits[:, None, None, None], maps, network(images))


def _find(
    images: Shaped[Tensor, "batch 1 height width"],
) -> tuple[Bool[Tensor, " batch"], tuple[Tensor, Tensor], tuple[int, int]]:
    """Which images fit into a window; first rows and columns of cells that are not blank; how many cells there are."""
    size = images.shape[2] // CELL, images.shape[3] // CELL
    filled = (images != 0).unflatten(3, (size[1], CELL)).unflatten(2, (size[0], CELL))[:, 0]
    filled = filled.any(4).any(2)  # (batch, rows, columns) of cells
    (top, bottom), (left, right) = (_extent(filled.any(other)) for other in (2, 1))
    rows, columns = _window_size(size)
    return (bottom - top < rows) & (right - left < columns), (top, left), size


def _window_size(size: tuple[int, int]) -> tuple[int, int]:
    return min(WINDOW[0], size[0]), min(WINDOW[1], size[1])


def _cells(first: Int[Tensor, " images"], count: int, size: int) -> Int[Tensor, "images cells"]:
    """So many rows or columns of cells from the first on, all of them within the image."""
    return first.clamp(max=size - count)[:, None] + torch.arange(count, device=first.device)


def _extent(filled: Bool[Tensor, "batch cells"]) -> tuple[Int[Tensor, " batch"], Int[Tensor, " batch"]]:
    """First and last cell that is filled; the first and the last there is where none is."""
    flags = filled.byte()
    return flags.argmax(1), filled.shape[1] - 1 - flags.flip(1).argmax(1)


def _places(part: Part, scale: int) -> tuple[Tensor, slice, Tensor, Tensor]:
    """Index of the pixels of windows, with ``scale`` of them a side in each cell."""
    index, rows, columns = part
    pixels = torch.arange(scale, device=index.device)
    y, x = ((cells[:, :, None] * scale + pixels).flatten(1) for cells in (rows, columns))
    return index[:, None, None], slice(None), y[:, :, None], x[:, None]
