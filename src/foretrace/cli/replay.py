"""The command that compares recorded motions with simulated ones."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def evaluate_replay(
    recordings: Positional[tuple[Path, ...]],
    out: Path | None = None,
    engine: Literal["mujoco", "bullet"] = "mujoco",
    timestep: float = 0.001,
) -> None:
    """Simulate recorded motions of rigid bodies from their first frame, and measure how far the simulation strays.

    Args:
        recordings: Files of recordings.
        out: Folder to write to: errors.csv over time, summary.json.
        engine: Physics engine.
        timestep: Time step in seconds.
    """
    import json

    import pandas as pd
    from rich.console import Console
    from rich.table import Table

    from foretrace.errors import DatasetError
    from foretrace.experiments.replay import replay
    from foretrace.interactions.motions import read_recordings

    if not recordings:
        raise DatasetError("no recording is given: name at least one file")
    found = [recording for file in recordings for recording in read_recordings(file)]
    if len({recording.name for recording in found}) < len(found):
        raise DatasetError("two recordings have the same name: give every one its own")
    replays = [replay(recording, engine, timestep) for recording in found]
    summaries = [each.summary() for each in replays]
    table = Table(title=f"Recorded against simulated in {engine}", title_justify="left")
    table.add_column("recording")
    for heading in (
        "time\ns",
        "position error\nmean, cm",
        "final\ncm",
        "rotation error\nmean, deg",
        "final\ndeg",
    ):
        table.add_column(heading, justify="right")
    table.add_column("side down\nat the end")
    for row in summaries:
        table.add_row(
            row["recording"],
            f"{row['duration_s']:.2f}",
            f"{100 * row['mean_position_error_m']:.2f}",
            f"{100 * row['final_position_error_m']:.2f}",
            f"{row['mean_rotation_error_deg']:.1f}",
            f"{row['final_rotation_error_deg']:.1f}",
            "right" if row["right_face"] else "wrong",
        )
    Console().print(table)
    if out is None:
        return
    out.mkdir(parents=True, exist_ok=True)
    errors = pd.DataFrame([row for each in replays for row in each.rows()])
    errors.to_csv(out / "errors.csv", index=False, float_format="%.6f")
    share = sum(row["right_face"] for row in summaries) / len(summaries)
    result = {"engine": engine, "timestep_s": timestep, "share_right_face": share, "recordings": summaries}
    (out / "summary.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(out / "errors.csv")
    print(out / "summary.json")
