"""The way from camera to prediction, proved against simulated films: calibrate, see, track, import, predict.

Usage: python benchmarks/closed_loop.py --run runs/im-cnn [--films build/films] [--num 10] [--data data/paper]
       [--stills 96] [--out docs/results/perception.json] [--picture docs/images/perception.jpg]
       python benchmarks/closed_loop.py --conditions 32 --out docs/results/perception-conditions.json
           --picture docs/images/shadows.jpg

Films are made once and kept. Stills are first frames of further lever-ups: of these, views alone are compared, with the
camera known exactly; also under conditions that films do not have by default: shadows, patterned tables, objects of the
table's colour. Everything after that sees pictures, time stamps and the marker layout alone; the truth
is opened only to compare.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from foretrace.actions import LeverUp, Motion, ToolPath
from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform, pose_to_matrix, rotation_angle, transform_points
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import read_image
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel, sample_prism
from foretrace.perception.board import Board
from foretrace.perception.calibration import calibrate, read_images
from foretrace.perception.importing import ONSET_SHIFT, Contact, Imported, import_recording
from foretrace.perception.markers import MarkerLayout, detect_markers
from foretrace.perception.overlay import OBSERVED, PREDICTED, draw_overlay
from foretrace.perception.photo import MaskMethod, PhotoConfig, observe_photo
from foretrace.perception.recordings import open_recording
from foretrace.perception.views import Observation, PlacedObject
from foretrace.predictor import load_predictor
from foretrace.simulation.lens import WEBCAM
from foretrace.simulation.recording import RecordingConfig, photograph_board, record_lever_up
from foretrace.trajectories import mean_distance, warped_distance

HEIGHT = 0.02
BOARD = Board()
CONDITIONS: dict[str, dict] = {
    "shadows": {"shadows": True},
    "shadows_wooden": {"shadows": True, "table": "wooden"},
    "shadows_speckled": {"shadows": True, "table": "speckled"},
    "brown_on_wooden": {"shadows": True, "table": "wooden", "object_colour": "brown"},
    "grey_on_plain": {"shadows": True, "object_colour": "grey"},
}
"""What makes stills harder than the others."""


def subject(number: int) -> tuple[ObjectModel, LeverUp]:
    rng = np.random.default_rng([2026, number])
    obj = sample_prism(rng, 3 + number % 8)
    return obj, LeverUp.at_edge(obj, int(rng.integers(len(obj.corners))), float(rng.uniform(0.3, 0.7)))


def film_config(number: int) -> RecordingConfig:
    rng = np.random.default_rng([4096, number])
    side = float(rng.choice([-1, 1]))
    return RecordingConfig(
        depth_every=10, azimuth=side * float(rng.uniform(0.5, 1.3)), slant=float(rng.uniform(0.5, 0.7))
    )


def make_films(root: Path, num: int) -> None:
    if not (root / "board").is_dir():
        (root / "board").mkdir(parents=True)
        for k, picture in enumerate(photograph_board(BOARD.draw(4000.0), BOARD.size, seed=1)):
            cv2.imwrite(str(root / "board" / f"{k:02d}.png"), picture)
    for number in range(num):
        folder = root / f"{number:02d}"
        if not (folder / "truth.json").is_file():
            record_lever_up(*subject(number), folder, film_config(number), seed=number)
            print(f"filmed {folder}", flush=True)


def make_still(folder: Path, number: int, **condition) -> None:
    """One frame, before the blade moves."""
    if not (folder / "truth.json").is_file():
        config = replace(film_config(number), depth_every=1, **condition)
        short = 1.5 / config.frames_per_second - config.lead_time - ToolPath().duration
        record_lever_up(*subject(number), folder, replace(config, tail_time=short), seed=number)


def pointed_at(folder: Path, number: int) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Poses of camera and object over the table in a still, and the pixel of the contact."""
    truth = json.loads((folder / "truth.json").read_text())
    T_table_camera = np.array(truth["T_table_camera"])
    T_table_object = pose_to_matrix(np.array(truth["object_poses_in_table"][:1]))[0]
    obj, action = subject(number)
    rim = transform_points(T_table_object, np.array([[*action.contact, obj.height]]))
    column, row = WEBCAM.project(rim, invert_transform(T_table_camera))[0]
    return T_table_camera, T_table_object, (float(column), float(row))


def drawn_box(pixels: np.ndarray, margin: int = 20) -> tuple[int, int, int, int]:
    """The box that somebody draws round an object."""
    (left, top), (right, bottom) = pixels.min(axis=0) - margin, pixels.max(axis=0) + margin
    return int(left), int(top), int(right - left), int(bottom - top)


def measure_still(
    root: Path, number: int, hows: Sequence[str] = ("background", "depth"), **condition
) -> dict:
    """How well the first frame of a lever-up shows the view, the camera's pose and lens being known."""
    folder, (obj, action) = root / f"{number}", subject(number)
    make_still(folder, number, **condition)
    T_table_camera, T_table_object, pixel = pointed_at(folder, number)
    exact, result = TopDownView.of(obj, action), {"still": number, "corners": len(obj.corners)}
    placed, T_camera_table = PlacedObject(obj, T_table_object), invert_transform(T_table_camera)
    silhouette = [WEBCAM.project(placed.outline(z), T_camera_table) for z in (0.0, obj.height)]
    for how in hows:
        try:
            sight = sight_of(
                folder, T_table_camera, WEBCAM, pixel, how, drawn_box(np.concatenate(silhouette))
            )
        except PerceptionError as error:
            result |= {f"refused_{how}": str(error).split(":")[0]}
            continue
        T_table_action = T_table_object @ invert_transform(action.T_action_object)
        turn = rotation_angle(sight.T_table_action[:3, :3], T_table_action[:3, :3])
        result |= {f"iou_{how}": overlap(sight.view, exact), f"turn_{how}_deg": float(np.rad2deg(turn))}
        result[f"corners_{how}"] = len(sight.placed.object.corners)
    return result


def summarise_stills(stills: list[dict], hows: Sequence[str] = ("background", "depth")) -> dict:
    summary: dict = {"count": len(stills)}
    for how in hows:
        seen = [still for still in stills if f"iou_{how}" in still]
        if len(seen) < len(stills):
            summary[f"refused_{how}"] = len(stills) - len(seen)
        if not seen:
            continue
        overlaps = np.array([still[f"iou_{how}"] for still in seen])
        summary |= {
            f"iou_{how}_median": float(np.median(overlaps)),
            f"iou_{how}_min": float(overlaps.min()),
            f"iou_{how}_below_0.98": int((overlaps < 0.98).sum()),
            f"turn_{how}_max_deg": max(still[f"turn_{how}_deg"] for still in seen),
            f"corners_right_{how}": sum(still["corners"] == still[f"corners_{how}"] for still in seen),
        }
    return summary


def measure_conditions(root: Path, num: int) -> dict:
    """Stills under each condition: the first half was looked at while shadows were learned to tell, the second not."""
    rows, summary = {}, {}
    for name, condition in CONDITIONS.items():
        hows = ["background", "depth"] + ["grabcut"] * ("object_colour" in condition)
        rows[name] = [measure_still(root / name, 100 + k, hows, **condition) for k in range(num)]
        halves = {"looked_at": rows[name][: num // 2], "fair": rows[name][num // 2 :]}
        summary[name] = {half: summarise_stills(some, hows) for half, some in halves.items()}
        print(json.dumps({name: summary[name]}, indent=1), flush=True)
    return {"summary": summary, "stills": rows}


def picture_conditions(out: Path, root: Path) -> None:
    """Two stills with shadows, and the outlines that were found."""
    halves = []
    for name, number in (("shadows", 113), ("shadows_wooden", 105)):
        folder = root / name / f"{number}"
        T_table_camera, _, pixel = pointed_at(folder, number)
        sight = sight_of(folder, T_table_camera, WEBCAM, pixel, "background")
        frame = next(open_recording(folder).frames())
        large = cv2.resize(frame.image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        outline = sight.placed.outline(HEIGHT)
        drawn = draw_overlay(large, WEBCAM.scaled(2), T_table_camera, outline, {})
        middle = WEBCAM.scaled(2).project(outline, invert_transform(T_table_camera)).mean(axis=0)
        left, top = np.maximum(middle.astype(int) - [400, 330], 0)
        halves.append(drawn[top : top + 660, left : left + 800])
    both = cv2.resize(np.hstack(halves), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(out), both, [cv2.IMWRITE_JPEG_QUALITY, 88])


def sight_of(
    folder: Path,
    T_table_camera: np.ndarray,
    camera: PinholeCamera,
    pixel: tuple[float, float],
    how: MaskMethod,
    box: tuple[int, int, int, int] | None = None,
) -> Observation:
    """What the first frame alone shows of an object of unknown shape."""
    frame = next(open_recording(folder).frames())
    return observe_photo(
        frame.image,
        camera,
        pixel,
        T_table_camera=T_table_camera,
        depth=frame.depth if how == "depth" else None,
        background=read_image(folder / "background.png"),
        config=PhotoConfig(how, box, None if how == "depth" else HEIGHT, hull=True),
    )


def overlap(a: TopDownView, b: TopDownView) -> float:
    return float((a.mask & b.mask).sum() / (a.mask | b.mask).sum())


def measure(folder: Path, camera: PinholeCamera, predictor, picture: Path | None) -> dict:
    truth = json.loads((folder / "truth.json").read_text())
    number = int(folder.name)
    obj, action = subject(number)
    T_truth = pose_to_matrix(np.array(truth["object_poses_in_table"]))
    contact = Contact(point=(float(action.contact[0]), float(action.contact[1])))
    found = import_recording(
        open_recording(folder), camera, MarkerLayout.load(folder / "markers.json"), contact, obj
    )
    position = np.linalg.norm(found.T_table_object[:, :3, 3] - T_truth[:, :3, 3], axis=1)
    turn = rotation_angle(found.T_table_object[:, :3, :3], T_truth[:, :3, :3])
    # Somebody points at the contact in the first frame.
    T_camera_table = invert_transform(found.T_table_camera)
    rim = transform_points(T_truth[0], np.array([[*action.contact, obj.height]]))
    column, row = camera.project(rim, T_camera_table)[0]
    exact = TopDownView.of(obj, action)
    com = obj.mass_properties(1.0).com
    com_in_action = transform_points(action.T_action_object, com[None])[0]
    T_action_table = invert_transform(np.array(truth["T_table_action"]))
    moved = transform_points(T_action_table @ T_truth, com[None])[:, 0]
    times = np.array(truth["times"]) - truth["action_start"]
    result = {
        "film": number,
        "corners": len(obj.corners),
        "outcome": truth["outcome"],
        "imported_outcome": str(found.interaction.effect.outcome),
        "frames_seen": float(found.track.seen.mean()),
        "position_error_mm": {"median": 1e3 * float(np.median(position)), "max": 1e3 * float(position.max())},
        "rotation_error_deg": {
            "median": float(np.rad2deg(np.median(turn))),
            "max": float(np.rad2deg(turn.max())),
        },
        "start_error_s": found.start - truth["action_start"],
    }
    imagined = predictor.imagine(exact, com=com_in_action)
    grid = imagined.times[imagined.times <= times[-1]]
    path = np.column_stack([np.interp(grid, times, moved[:, i]) for i in range(3)])
    slip = found.interaction.effect.slip_index
    end = len(grid) if slip is None else min(slip, len(grid))
    result["error_exact_cm"] = 100 * float(mean_distance(imagined.com_trajectory[:end], path[:end]))
    for how in ("background", "depth"):
        sight = sight_of(folder, found.T_table_camera, camera, (float(column), float(row)), how)
        seen = predictor.imagine(sight.view, com=sight.com_in_action)
        # In the table frame: an action frame that was seen askew counts as an error of the prediction.
        in_table = transform_points(sight.T_table_action, seen.com_trajectory)
        in_action = transform_points(T_action_table, in_table)
        result[f"iou_{how}"] = overlap(sight.view, exact)
        result[f"error_{how}_cm"] = 100 * float(mean_distance(in_action[:end], path[:end]))
        if how == "background" and picture is not None:
            save_picture(picture, folder, camera, found, sight, in_table[:end], truth, com)
    observed = found.interaction.effect.com_trajectory[:end]
    result["error_imported_dtw_cm"] = 100 * warped_distance(seen.com_trajectory[:end], observed).distance
    return result


def save_picture(
    out: Path,
    folder: Path,
    camera: PinholeCamera,
    found: Imported,
    sight: Observation,
    path: np.ndarray,
    truth: dict,
    com,
) -> None:
    frames = list(open_recording(folder).frames())
    there = np.isfinite(found.T_table_object[:, 0, 0])
    effect = found.interaction.effect
    until = found.start + effect.times[min(len(path), len(effect.times)) - 1]
    there &= (found.track.times >= found.start) & (found.track.times <= until)
    observed = transform_points(found.T_table_object[there], com[None])[:, 0]
    paths = {"observed": (observed, OBSERVED), "predicted": (path, PREDICTED)}
    layout = MarkerLayout.load(folder / "markers.json")
    halves = []
    for frame, outline in (
        (frames[0], sight.placed.outline(HEIGHT)),
        (frames[int(np.flatnonzero(there)[-1])], None),
    ):
        corners = detect_markers(frame.image, layout.dictionary).corners
        # Drawn large: the paths are a few centimetres long.
        large = cv2.resize(frame.image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        drawn = draw_overlay(large, camera.scaled(2), found.T_table_camera, outline, paths, 2 * corners + 0.5)
        halves.append(drawn[: 2 * 600, 2 * 240 : 2 * 1040])
    out.parent.mkdir(parents=True, exist_ok=True)
    both = cv2.resize(np.hstack(halves), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(out), both, [cv2.IMWRITE_JPEG_QUALITY, 88])


def judge_simulated(data: Path) -> dict:
    """Outcomes told from motion alone against those that saw the blade, and when objects begin to move."""
    dataset, agree, onsets = Dataset.open(data), 0, []
    chosen = range(0, len(dataset), 2)
    for row in chosen:
        interaction = dataset[row]
        effect = interaction.effect
        unseen = Motion(effect.times, effect.pose_trajectory, effect.tool_trajectory, effect.joint_trajectory)
        judgement = interaction.action.judge(unseen, interaction.object, effect.com_trajectory)
        agree += judgement.outcome == effect.outcome
        shift = np.linalg.norm(effect.com_trajectory - effect.com_trajectory[0], axis=1)
        k = int((shift > ONSET_SHIFT).argmax())
        onsets.append(np.interp(ONSET_SHIFT, shift[k - 1 : k + 1], effect.times[k - 1 : k + 1]))
    return {
        "interactions": len(chosen),
        "outcomes_agree": int(agree),
        "onset_median_s": float(np.median(onsets)),
        "onset_deviation_s": float(np.std(onsets)),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--run", type=Path, help="without it only stills under conditions are measured")
    parser.add_argument("--films", type=Path, default=Path("build/films"))
    parser.add_argument("--num", type=int, default=10)
    parser.add_argument("--stills", type=int, default=0)
    parser.add_argument("--conditions", type=int, default=0, help="stills of each kind, without --run")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument(
        "--data", type=Path, help="simulated data set on which judging from motion is checked"
    )
    options = parser.parse_args()
    content: dict = {"versions": {"foretrace": version("foretrace"), "opencv": cv2.__version__}}
    if options.run is None:
        content |= measure_conditions(options.films / "stills", options.conditions)
        if options.picture is not None:
            picture_conditions(options.picture, options.films / "stills")
    else:
        content |= measure_films(options)
    if options.out is not None:
        options.out.write_text(json.dumps(content, indent=1) + "\n")


def measure_films(options: argparse.Namespace) -> dict:
    """Films and stills as they are by default, and what a predictor makes of them."""
    make_films(options.films, options.num)
    calibration = calibrate(read_images([options.films / "board"]), BOARD)
    predictor = load_predictor(options.run)
    rows, refused = [], {}
    for number in range(options.num):
        picture = options.picture if number == 5 else None
        try:
            rows.append(measure(options.films / f"{number:02d}", calibration.camera, predictor, picture))
        except PerceptionError as error:
            refused[number] = str(error)
            print(f"film {number} is refused: {error}", flush=True)
            continue
        print(json.dumps(rows[-1]), flush=True)
    errors = {
        name: np.array([row[f"error_{name}_cm"] for row in rows]) for name in ("exact", "background", "depth")
    }
    summary = {
        "films": options.num,
        "films_refused": len(refused),
        "calibration_error_pixels": calibration.error,
        "position_error_median_mm": float(np.median([row["position_error_mm"]["median"] for row in rows])),
        "position_error_median_of_worst_film_mm": max(row["position_error_mm"]["median"] for row in rows),
        "position_error_max_mm": max(row["position_error_mm"]["max"] for row in rows),
        "rotation_error_median_deg": float(np.median([row["rotation_error_deg"]["median"] for row in rows])),
        "rotation_error_median_of_worst_film_deg": max(row["rotation_error_deg"]["median"] for row in rows),
        "rotation_error_max_deg": max(row["rotation_error_deg"]["max"] for row in rows),
        **{
            f"iou_{how}_median": float(np.median([row[f"iou_{how}"] for row in rows]))
            for how in ("background", "depth")
        },
        **{f"iou_{how}_min": min(row[f"iou_{how}"] for row in rows) for how in ("background", "depth")},
        **{f"error_{name}_mean_cm": float(values.mean()) for name, values in errors.items()},
        **{
            f"error_ratio_{name}": float(errors[name].mean() / errors["exact"].mean())
            for name in ("background", "depth")
        },
        "outcomes_right": sum(row["outcome"] == row["imported_outcome"] for row in rows),
        "start_error_median_s": float(np.median(np.abs([row["start_error_s"] for row in rows]))),
    }
    judged = None if options.data is None else judge_simulated(options.data)
    stills = [measure_still(options.films / "stills", 100 + k) for k in range(options.stills)]
    summary["stills"] = summarise_stills(stills) if stills else None
    print(json.dumps({"summary": summary, "judging": judged}, indent=1))
    return {
        "run": str(options.run),
        "summary": summary,
        "judging": judged,
        "films": rows,
        "stills": stills,
        "refused": refused,
    }


if __name__ == "__main__":
    main()
