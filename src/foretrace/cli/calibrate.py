"""The command that calibrates a camera."""

from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.cli.console import say
from foretrace.errors import PerceptionError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.board import Board
from foretrace.perception.calibration import calibrate as calibrate_camera
from foretrace.perception.calibration import read_images, refine_camera
from foretrace.perception.markers import MarkerLayout, align_patterns, detect_markers


def calibrate(
    board: Annotated[OmitArgPrefixes[Board], arg(name="board")],
    images: Positional[tuple[Path, ...]] = (),
    out: Path = Path("camera.json"),
    print_board: Path | None = None,
    print_markers: Path | None = None,
    family: str = "apriltag_36h11",
    ids: tuple[int, ...] = (0, 1, 2, 3, 10),
    side: float = 0.05,
    refine: Path | None = None,
    markers: Path | None = None,
) -> None:
    """Calibrate a camera from images of a ChArUco board, or write the board or markers for printing.

    With --refine, a camera file that does not quite fit its images is adjusted by markers of known size instead.

    Args:
        board: The board, as measured on the print.
        images: Images or folders of images: 10 to 20 of the board, slanted, near and far, also in the corners.
        out: File for the camera.
        print_board: Write the board to this .png or .pdf file instead.
        print_markers: Write markers to this .pdf, .svg or .png file instead: those of --markers, or of --ids.
        family: Dictionary of the markers that are written.
        ids: Their numbers.
        side: Side of their black squares [m].
        refine: Camera file whose focal lengths and first radial distortion are adjusted to the images.
        markers: Marker layout; for --refine, its table's markers are in the images, seen from several sides.
    """
    if print_board is not None:
        board.save(print_board)
        width, height = (1000 * length for length in board.size)
        print(f"{print_board}: print at 100 %, the board then measures {width:.1f} x {height:.1f} mm")
        return
    if print_markers is not None:
        _print_markers(print_markers, markers, family, dict.fromkeys(ids, side))
        return
    if not images:
        raise PerceptionError(
            "no images are given: name images of the board, --print-board FILE or --print-markers FILE"
        )
    if (refine is None) != (markers is None):
        raise PerceptionError("--refine CAMERA and --markers LAYOUT go together: give both, or neither")
    out.parent.mkdir(parents=True, exist_ok=True)
    if refine is not None and markers is not None:
        _refine(images, refine, markers, out)
        return
    found = calibrate_camera(read_images(images), board)
    for name, error in found.errors.items():
        print(f"{name}: {error:.3f} pixels")
    for name, reason in found.left_out.items():
        say(f"left out: {name} {reason}")
    for note in found.notes:
        say(note)
    deviations = found.deviations
    found.camera.save(
        out, error_pixels=found.error, images=len(found.errors), standard_deviations_pixels=deviations
    )
    values = (
        f"{getattr(found.camera, name):.1f} ± {deviations[name]:.1f}" for name in ("fx", "fy", "cx", "cy")
    )
    print("focal lengths {} and {}, centre {}, {} pixels".format(*values))
    print(f"error {found.error:.3f} pixels over {len(found.errors)} images")
    print(out)


def _print_markers(out: Path, layout: Path | None, family: str, sides: dict[int, float]) -> None:
    """Write the markers of a layout, or of a family."""
    from foretrace.perception.printing import print_markers

    if layout is not None:
        known = MarkerLayout.load(layout)
        family, sides = known.dictionary, {**known.table.sides, **known.object.sides}
    pages = print_markers(out, family, sides)
    lengths = ", ".join(f"{1000 * side:.1f}" for side in sorted(set(sides.values())))
    print(
        f"{out}: {len(sides)} marker{'s' * (len(sides) > 1)} of {family} on {pages} page{'s' * (pages > 1)}; "
        f"print at 100 %, their black squares then measure {lengths} mm"
    )


def _refine(images: tuple[Path, ...], stated: Path, markers: Path, out: Path) -> None:
    """Adjust a camera file to images of the table's markers."""
    from foretrace.perception.calibration import read_images

    layout = MarkerLayout.load(markers)
    name = layout.dictionary
    seen = [
        align_patterns(image, detect_markers(image, name), name) for image in read_images(images).values()
    ]
    camera, error = refine_camera(seen, layout.table, PinholeCamera.load(stated))
    camera.save(out, error_pixels=error, images=len(seen))
    print(f"focal lengths {camera.fx:.1f} and {camera.fy:.1f} pixels")
    print(f"error {error:.3f} pixels over {len(seen)} images")
    print(out)
