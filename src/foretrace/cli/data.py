"""Commands about data sets: data, data merge, data split, data sample, show."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from foretrace.cli.console import print_outcomes, when_interrupted
from foretrace.errors import CommandError, DatasetError, counted
from foretrace.files import write_json
from foretrace.interactions import derive
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.description import describe_dataset
from foretrace.interactions.doctor import examine
from foretrace.interactions.upgrade import upgrade as upgrade_in_place
from foretrace.urls import as_place


def data(path: Positional[Path], repair: bool = False, upgrade: bool = False, out: Path | None = None) -> int:
    """Describe a data set and check it: checksums, schema, numbers, ids.

    Outcomes, how far objects were lifted, what varies, and everything that is wrong. The exit status is 1 if something
    is left to mend. `foretrace data merge`, `data split` and `data sample` make data sets of others.

    Args:
        path: Folder or URL of the data set.
        repair: Remove leftovers, set corrupt shards aside (`foretrace simulate` makes them again), and enter
            whole shards that miss their checksum.
        upgrade: Bring a data set of format version 1 to today's format first, in place.
        out: JSON file for the description.
    """
    place = as_place(path, DatasetError)
    if out is not None and isinstance(place, Path) and out.resolve().is_relative_to(place.resolve()):
        raise CommandError(f"--out {out} lies in the data set: choose another one")
    if upgrade:
        print(f"{path}: {counted(upgrade_in_place(path), 'interaction')} upgraded")
    diagnosis = examine(place, repair)
    left = sum(not finding.repaired for finding in diagnosis.findings)
    try:
        description = describe_dataset(Dataset.open(place))
    except DatasetError:
        if not left:
            raise
        print_outcomes(diagnosis.outcomes)
    else:
        _print_description(description)
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_json(out, description, indent=2)
    for finding in diagnosis.findings:
        print(f"{'repaired' if finding.repaired else 'found'}: {finding.file}: {finding.problem}")
    print(f"{place}: {counted(diagnosis.num_interactions, 'interaction')}, {counted(left, 'problem')} left")
    return int(left > 0)


def _print_description(description: dict) -> None:
    print_outcomes(description["outcomes"])
    for groups in (description["outcomes_by_action"], description["outcomes_by_kind"]):
        for name, counts in groups.items() if len(groups) > 1 else ():
            print(
                f"{name:>10} {sum(counts.values()):7d}: "
                + ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
            )
    for name, (low, high) in description["varies"].items():
        print(f"{name.replace('_', ' '):>42} {low:10.4g} to {high:.4g}")
    for name, value in description.items():
        if not isinstance(value, dict) and name != "interactions":
            print(f"{name.replace('_', ' '):>42} {value:10.4g}")


NOTHING_LEFT = "nothing was written; repeat the command"


def merge(paths: Positional[tuple[Path, ...]], out: Path, skip_duplicates: bool = False) -> None:
    """Make one data set of several.

    Interactions and objects are numbered anew; the data sets stay as they are.

    Args:
        paths: Folders or URLs of the data sets.
        out: Folder of the new data set.
        skip_duplicates: Leave out interactions that were there before, instead of refusing them.
    """
    with when_interrupted(NOTHING_LEFT):
        rows, skipped = derive.merge(paths, out, skip_duplicates)
    left_out = f", {counted(skipped, 'duplicate')} left out" if skipped else ""
    print(f"data set: {out}, {counted(rows, 'interaction')}{left_out}")


def split(
    path: Positional[Path],
    out: Path,
    shares: tuple[float, ...] = (0.8, 0.1, 0.1),
    names: tuple[str, ...] = derive.PARTS,
    by: Literal["object", "interaction"] = "object",
    seed: int = 0,
) -> None:
    """Make several data sets of one.

    Args:
        path: Folder or URL of the data set.
        out: Folder of the new data sets.
        shares: Share of each of them; they sum to 1.
        names: Names of their folders within --out.
        by: object: no object is in two of them. interaction: interactions are drawn at random.
        seed: Decides what goes where.
    """
    with when_interrupted(NOTHING_LEFT):
        counts = derive.split(path, out, shares, names, by, seed)
    for name, rows in counts.items():
        print(f"data set: {out / name}, {counted(rows, 'interaction')}")


def sample(path: Positional[Path], out: Path, number: int, seed: int = 0) -> None:
    """Make a data set of some interactions of another one, drawn at random.

    Args:
        path: Folder or URL of the data set.
        out: Folder of the new data set.
        number: Number of interactions.
        seed: Decides which ones.
    """
    with when_interrupted(NOTHING_LEFT):
        rows = derive.sample(path, out, number, seed)
    print(f"data set: {out}, {counted(rows, 'interaction')}")


def show(
    path: Positional[Path],
    id: int | None = None,
    out: Path | None = None,
    arm: bool = False,
    run: Path | None = None,
) -> None:
    """Draw a contact sheet of a data set, or one interaction as a picture and an animation.

    Args:
        path: Folder or URL of the data set.
        id: Number of the interaction to draw; without it, the contact sheet is drawn.
        out: File to write: .png, .svg or .pdf; with an id also .gif or .mp4. By default pictures go to the
            data set's folder figures.
        arm: Render the lever-up of --id in three dimensions, with the whole arm. Needs foretrace[sim].
        run: Folder of a training, whose predictor's most probable path and region are drawn too; with --arm only.
    """
    if arm or run is not None:
        _show_arm(path, id, out, arm, run)
        return
    from foretrace.pictures.animation import interaction_animation
    from foretrace.pictures.contact_sheet import contact_sheet
    from foretrace.pictures.scene import interaction_figure

    moving, still = (".gif", ".mp4"), (".png", ".svg", ".pdf")
    if out is not None and out.suffix.lower() not in moving + still:
        raise DatasetError(f"cannot draw to {out}: choose a name that ends in {', '.join(still + moving)}")
    if out is not None and out.suffix.lower() in moving and id is None:
        raise DatasetError(f"{out} would be an animation: choose the interaction with --id")
    dataset = _open_to_draw(path, out)
    stem = path / "figures" / ("contact-sheet" if id is None else f"interaction-{id}")
    if out is not None:
        targets = [out]
    else:
        targets = [stem.with_suffix(".png")] + ([stem.with_suffix(".gif")] if id is not None else [])
    for target in targets:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix.lower() in moving and id is not None:
            interaction_animation(dataset.with_id(id), target)
        else:
            figure = contact_sheet(dataset) if id is None else interaction_figure(dataset.with_id(id))
            figure.savefig(target)
        print(target)


def _open_to_draw(path: Path, out: Path | None) -> Dataset:
    """A data set whose pictures go to a file, or to its own folder."""
    dataset = Dataset.open(path)
    if out is None and not isinstance(dataset.path, Path):
        raise DatasetError(f"pictures of {dataset.path} are not written there: name a file with --out")
    return dataset


def _show_arm(path: Path, id: int | None, out: Path | None, arm: bool, run: Path | None) -> None:
    """Render one interaction with the arm."""
    if not arm:
        raise DatasetError(f"--run {run} goes with --arm: add it, or compare with `foretrace predict --data`")
    if id is None:
        raise DatasetError("--arm renders one interaction: choose it with --id")
    from foretrace.pictures.rendered import rendered_animation

    dataset = _open_to_draw(path, out)
    interaction, imagined = dataset.with_id(id), None
    if run is not None:
        from foretrace.export.episodes import choose

        imagined = choose(path, [id], run)[0].imagined
    target = path / "figures" / f"interaction-{id}-arm.gif" if out is None else out
    print(rendered_animation(interaction, target, imagined))
