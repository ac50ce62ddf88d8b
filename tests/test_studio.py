"""The studio: what a visitor chooses, what follows, and the page, driven over viser's protocol without a browser."""

import io
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image

import foretrace as ft
from foretrace import cli
from foretrace.errors import ForetraceError
from foretrace.geometry import transform_points
from foretrace.perception.example import HEIGHT, example_file
from foretrace.perception.photo import PhotoConfig, open_photo
from foretrace.predictor import load_imaginer
from foretrace.simulation.arm_parts import arm_poses
from foretrace.studio import saving
from foretrace.studio.arm import PERIOD, postures
from foretrace.studio.choices import Choices, link_of
from foretrace.studio.photographs import PhotoRequest, example_request, picture_of
from foretrace.studio.scenery import edges_of, futures_of, observed_motion, rim_segments, shown_times, tube
from foretrace.studio.session import LEVEL, Session
from foretrace.studio.shapes import EXAMPLES, example, from_file, from_text, prism_of
from foretrace.studio.texts import learned_html, verdict_html
from foretrace.studio.watching import WISHES
from foretrace.studio.work_queue import WorkQueue

TRIANGLE = "0 0\n0.12 0\n0.05 0.1\n"


def png(mask: np.ndarray) -> bytes:
    written = io.BytesIO()
    Image.fromarray(mask).save(written, "png")
    return written.getvalue()


PHOTO = ("photo.jpg", example_file("photo.jpg"))
SQUARE = png(np.pad(np.full((100, 120), 255, np.uint8), 30))

REFUSED = {
    "turn is 0.7: give a number from -0.6109 to 0.6109": lambda: Choices(turn=0.7),
    "along is nan: give a number": lambda: Choices(along=np.nan),
    "friction is 3: give a number from 0.5 to 1.1": lambda: Choices(friction=3),
    "density is 'heavy'": lambda: Choices(density="heavy"),
    "along is None": lambda: Choices(along=None),
    "exact is 1: give True or False": lambda: Choices(exact=1),
    "goal is 'fly': choose from lift": lambda: Choices(goal="fly"),
    "object of type str": lambda: Choices(object="pentagon"),
    "there is no choice 'colour'": lambda: Choices().changed(colour="red"),
    "the link is 9000 characters long": lambda: Choices.from_text("x" * 9000),
    "the link says 'along'": lambda: Choices.from_text("along"),
    "the link says 'colour:red'": lambda: Choices.from_text("colour:red"),
    "the link says along:'far'": lambda: Choices.from_text("along:far"),
    "the link says exact:'yes'": lambda: Choices.from_text("exact:yes"),
    "there is no example 'spoon'": lambda: Choices.from_text("object:spoon"),
    "the link says object:'1_2_x'": lambda: Choices.from_text("object:1_2_x"),
    "the link says object:'200_0_0_1'": lambda: Choices.from_text("object:200_0_0_1"),
    "2 corners": lambda: Choices.from_text("object:200_50_20_0_0_1_1"),
    "a cylinder does not fit into a link": lambda: Choices(object=ft.Cylinder(0.03, 0.1)).to_text(),
    "the corners are 30000 characters long": lambda: from_text("0 0 \n" * 6000),
    "corners.txt holds no corners": lambda: from_text(""),
    "corners.txt, line 2": lambda: from_text("0 0\n1 x\n"),
    "the outline has 500 corners: give at most 400": lambda: from_text(
        "".join(f"{0.1 * np.cos(a):.6f} {0.1 * np.sin(a):.6f}\n" for a in 2 * np.pi * np.arange(500) / 500)
    ),
    "mask.png is a mask: give its scale": lambda: from_file("mask.png", SQUARE),
    "mask.png": lambda: from_file("mask.png", b"no picture", scale=0.001),
    "large.stl has 9.0 MB": lambda: from_file("large.stl", bytes(9 << 20)),
    "part.stl": lambda: from_file("../../part.stl", b"solid nothing"),
    "'rain' cannot go wrong: choose from surprise me": lambda: Session().watch("rain"),
    "a cylinder cannot have an other shape": lambda: Session(
        Choices(object=ft.Cylinder(0.03, 0.1), along=0.3)
    ).watch("other shape"),
    "there is no photograph yet": lambda: PhotoRequest({}, 0.02).observe(),
    "background needs a photograph of the table": lambda: PhotoRequest({"photo": PHOTO}, 0.02).observe(),
    "grabcut needs a box": lambda: PhotoRequest({"photo": PHOTO}, 0.02, "grabcut").observe(),
    "colour needs the contact": lambda: PhotoRequest({"photo": PHOTO}, 0.02, "colour").observe(),
    "the box is '1 2 3'": lambda: PhotoRequest({"photo": PHOTO}, 0.02, box="1 2 3").observe(),
    "the contact is 'here'": lambda: PhotoRequest({"photo": PHOTO}, 0.02, contact="here").observe(),
    "height is -0.02": lambda: PhotoRequest({"photo": PHOTO}, -0.02, "threshold").observe(),
    "photo.png has 5000 x 4000 pixels": lambda: PhotoRequest(
        {"photo": ("photo.png", png(np.zeros((4000, 5000), bool)))}, 0.02, "threshold"
    ).observe(),
    "photo.jpg has 9.0 MB": lambda: PhotoRequest(
        {"photo": ("photo.jpg", bytes(9 << 20))}, 0.02, "threshold"
    ).observe(),
    "cannot read an image from photo.jpg": lambda: PhotoRequest(
        {"photo": ("../photo.jpg", b"no picture")}, 0.02, "threshold"
    ).observe(),
    "the photograph has": lambda: PhotoRequest({"photo": ("photo.png", SQUARE)}, 0.02, "threshold").observe(),
    "camera.yaml": lambda: PhotoRequest(
        {"photo": PHOTO, "camera": ("camera.yaml", b"[1, 2")}, 0.02, "threshold"
    ).observe(),
    "the point (x, y) [m]": lambda: Session().turn_from(np.array([0.0, np.inf])),
    "the contact (x, y) [m]": lambda: Session().move_to(np.array([np.nan, 0.0])),
}


@pytest.mark.usefixtures("untyped")
@pytest.mark.parametrize("message", REFUSED)
def test_mistakes_are_told_in_one_line(message):
    with pytest.raises(ForetraceError) as refused:
        REFUSED[message]()
    assert message in str(refused.value)
    assert "/tmp" not in str(refused.value)


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_can_be_levered(name):
    session = Session(Choices(object=example(name), along=0.1))
    assert sum(float(each[0]) for each in session.imagined.futures.outcomes().values()) == pytest.approx(1)
    assert Choices.from_text(session.choices.to_text()) == session.choices


def test_objects_come_from_text_masks_and_meshes():
    assert len(from_text(TRIANGLE).corners) == 3
    np.testing.assert_allclose(
        np.ptp(from_file("m.png", SQUARE, scale=0.001).corners, axis=0), [0.12, 0.1], atol=0.002
    )
    box = trimesh.creation.box((80, 60, 20)).export(file_type="stl")
    mesh = from_file("part.STL", box, scale=0.001)
    assert isinstance(mesh, ft.MeshObject)
    told = Choices(object=mesh).context
    assert (told["bevel_width"], told["bevel_height"]) == (mesh.bevel.width, mesh.bevel.height)
    assert from_file("t.csv", TRIANGLE.replace(" ", ",").encode(), height=0.03).height == 0.03


def test_a_photograph_shows_what_it_shows_to_the_command():
    seen = example_request().observe()
    folder = Path(ft.__file__).parent / "assets/example"
    commanded = open_photo(
        folder / "photo.jpg", (565.0, 209.0), background=folder / "background.jpg",
        config=PhotoConfig(mask="background", height=HEIGHT),
    )  # fmt: skip
    np.testing.assert_array_equal(seen.placed.object.corners, commanded.placed.object.corners)
    np.testing.assert_array_equal(seen.action.contact, commanded.action.contact)
    session = Session(Choices(object=seen.placed.object))
    session.take(seen.action)
    assert np.linalg.norm(session.action.contact - seen.action.contact) < 1e-9
    small = picture_of(seen, session.action, session.imagined).astype(int)
    assert small.shape == (270, 480, 3)
    assert (np.abs(small - picture_of(seen, session.action, None)).max(axis=2) > 60).mean() > 0.002


def test_the_arm_is_where_the_simulated_arm_is():
    path = Choices(speed=1.2).path
    action = ft.LeverUp.at_edge(EXAMPLES["bracket"], 1, path=path)
    simulated = ft.simulate(EXAMPLES["bracket"], action).effect
    moved = arm_poses(action.tool, simulated.joint_trajectory)
    times = np.rint(simulated.times / PERIOD).astype(int)
    shown = postures(path)[:, times[times < postures(path).shape[1]]]
    apart = np.linalg.norm((moved[:, : shown.shape[1]] - shown)[..., :3], axis=-1)
    assert len(shown) == 10
    assert apart.max() < 0.004
    assert np.ptp(shown[-1, :, 2]) > 0.05  # the holder lifts


def test_a_link_holds_all_choices():
    outline = prism_of(np.array([(0, 0), (0.1, 0), (0.1, 0.08), (0.0, 0.1)]), 0.015)
    chosen = Choices(
        outline, 0.4321, -0.2, friction=None, exact=False, goal="move", heading=1.5, imaginer="twin"
    )
    again = Choices.from_text(link_of("localhost:8080", chosen).rpartition("/")[2])
    np.testing.assert_allclose(again.object.corners, outline.corners, atol=6e-5)
    assert again.changed(object=outline) == chosen
    assert link_of("localhost:8080", Choices()) == "http://localhost:8080/"


def test_the_contact_follows_a_point_and_the_futures_follow_the_contact():
    session = Session()
    before = session.imagined
    assert session.imagined is before  # worked out once
    session.move_to(np.array([0.2, 0.03]))
    ring = session.choices.object.corners
    assert (
        np.linalg.norm(session.action.contact - [0.2, 0.03])
        < np.linalg.norm(ring - [0.2, 0.03], axis=1).min() + 0.002
    )
    after = session.imagined
    assert after is not before
    session.change(goal="tilt", angle=0.4)
    assert session.imagined is after  # which has nothing to do with the goal


def test_the_session_imagines_what_the_library_does():
    session = Session(Choices(along=0.3, turn=0.1, friction=None, sweep=0.6))
    action, obj = session.action, session.choices.object
    com = transform_points(action.T_action_object, obj.mass_properties(1.0).com[None])[0]
    bevel = {"bevel_width": 0.009, "bevel_height": 0.003}
    told = bevel | {"tool_friction": 0.3, "density": 600.0, "contact_error": 0.0}
    direct = load_imaginer().imagine(ft.TopDownView.of(obj, action), action, context=told, com=com)
    np.testing.assert_array_equal(direct.com_trajectory, session.imagined.com_trajectory)
    assert np.isnan(session.imagined.context["friction"])


def test_what_is_unknown_is_drawn_and_the_region_is_held_to_account():
    session = Session(Choices(friction=None, exact=False))
    runs = [session.simulate() for _ in range(6)]
    assert len({each.drawn["friction"] for each in runs}) == 6
    assert all(0.5 <= each.interaction.physics.friction <= 1.1 for each in runs)
    assert all(each.interaction.physics.tool_friction == 0.3 for each in runs)
    assert session.simulations == [each.held for each in runs]
    assert sum(session.simulations) >= 4
    session.change(along=0.5)
    assert session.simulations == []
    known = Session().simulate()
    assert known.drawn == {}


def test_planning_jumps_to_the_best_contact():
    session = Session(Choices(goal="move", heading=0.5))
    rim = session.rim
    found = session.plan_best()
    np.testing.assert_allclose(session.action.contact, found.action.contact, atol=1e-9)
    np.testing.assert_allclose(session.action.direction, found.action.direction, atol=1e-9)
    assert found.rim.cost.min() == pytest.approx(rim.cost.min())
    session.change(heading=-2.0)
    assert session.plan is None
    assert (
        np.linalg.norm(session.rim.points[session.rim.cost.argmin()] - rim.points[rim.cost.argmin()]) > 0.03
    )


def test_errors_are_kept_until_something_else_is_chosen():
    session = Session(Choices(object=prism_of(np.array([(0, 0), (0.5, 0), (0.5, 0.02), (0, 0.02)]))))
    for _ in range(2):
        with pytest.raises(ForetraceError):
            _ = session.imagined
    session.change(object=example("book"))
    assert session.imagined.times[0] == 0


@pytest.mark.parametrize("wish", ["surprise me", "nothing", "slip", "freeze"])
def test_a_monitor_watches_what_goes_wrong(wish):
    session = Session(seed=WISHES.index(wish))
    watched = session.watch(wish)
    assert session.watched is watched
    assert len(watched.verdicts) == len(watched.times) == len(watched.poses)
    assert (watched.fault == "") == (wish == "nothing")
    if wish in ("freeze", "slip"):
        assert watched.alarm is not None
        assert watched.truth.startswith(wish)
    shown = verdict_html(watched, len(watched.times) - 1)
    assert "In truth" in shown
    assert "In truth" not in verdict_html(watched, 3)
    assert ("alarm at" in shown) == (watched.alarm is not None)
    session.change(along=0.4)
    assert session.watched is None


def test_three_lever_ups_narrow_what_is_believed():
    told = []
    truth, beliefs = Session(seed=2).learn(lambda truth, beliefs: told.append(learned_html(truth, beliefs)))
    assert [f"lever-up {k} of 3" in html for k, html in enumerate(told, 1)] == [True] * 3
    assert set(truth) == {"friction", "tool_friction", "density"}
    prior, last = ft.Belief(), beliefs[-1]
    assert len(beliefs) == 3
    assert last.std["tool_friction"] < 0.6 * prior.std["tool_friction"]
    assert abs(last.mean["tool_friction"] - truth["tool_friction"]) < 3 * last.std["tool_friction"]
    shown = learned_html(truth, beliefs)
    assert "after 3" in shown
    assert "lever-up" not in shown
    assert shown.count("±") == 12


def test_a_row_of_a_data_set_is_replayed():
    prism = EXAMPLES["bracket"]
    recorded = ft.simulate(prism, ft.LeverUp.at_edge(prism, 1), embodiment="tool")
    session = Session()
    watched = session.replay(recorded)
    np.testing.assert_allclose(session.action.contact, recorded.action.contact, atol=1e-9)
    np.testing.assert_array_equal(watched.poses, recorded.effect.pose_trajectory)
    assert watched.truth == f"{recorded.effect.outcome}, as the data set has it"
    assert len(watched.verdicts) == len(recorded.effect.times)
    with pytest.raises(ForetraceError, match="the row is no lever-up"):
        session.replay(replace(recorded, action=ft.Push((0.0, 0.0), (1.0, 0.0))))


@pytest.mark.parametrize(
    "choices",
    [
        Choices(along=0.3, turn=0.1, friction=None, goal="move", heading=0.5),
        Choices(
            object=example("box"), goal="tilt", exact=False, density=None, tool_friction=None, friction=None
        ),
        Choices(imaginer="twin", goal="turn-over"),
    ],
)
def test_the_python_lines_do_the_same(choices):
    session = Session(choices)
    names: dict = {}
    lines = saving.python_lines(session)
    exec(compile(lines.split("plan = ")[0], "lines", "exec"), names)
    np.testing.assert_allclose(names["imagined"].com_trajectory, session.imagined.com_trajectory, atol=1e-6)
    goal = lines.split("ft.plan(obj, ")[1].split(", context")[0]
    assert eval(goal, names) == session.choices.wanted
    compile(lines, "lines", "exec")


def test_pictures_and_plans_are_saved():
    session = Session()
    with pytest.raises(ForetraceError, match="press plan first"):
        saving.plan_file(session.plan)
    assert saving.picture(session, session.simulate().interaction)[:4] == b"\x89PNG"


# --- what is drawn -----------------------------------------------------------------------------------------


def test_motions_are_drawn_in_the_objects_frame():
    session = Session(Choices(along=0.62))
    action, imagined = session.action, session.imagined
    futures = futures_of(imagined, action, LEVEL)
    com = session.choices.object.mass_properties(1.0).com
    np.testing.assert_allclose(futures[0].path[0], com, atol=1e-6)
    np.testing.assert_allclose(futures[0].poses[0], np.eye(4), atol=1e-5)
    carried = transform_points(futures[0].poses[-1], com[None])[0]
    np.testing.assert_allclose(carried, futures[0].path[-1], atol=1e-6)
    assert futures[0].probability == imagined.futures.probability.max()
    assert len(futures[0].path) == len(shown_times(imagined, action)) < len(imagined.times)
    seen = observed_motion(session.simulate().interaction.effect.pose_trajectory, action, com)
    np.testing.assert_allclose(seen.path[0], com, atol=2e-3)
    np.testing.assert_allclose(seen.poses[0], np.eye(4), atol=2e-3)
    assert np.linalg.norm(seen.path[-1] - futures[0].path[-1]) < 0.01


def test_a_tube_encloses_its_path():
    path = np.column_stack([np.linspace(0, 0.1, 20), np.zeros(20), 0.02 + 0.02 * np.linspace(0, 1, 20) ** 2])
    vertices, faces = tube(path, np.full(20, 0.01))
    body = trimesh.Trimesh(vertices, faces)
    gaps = np.linalg.norm(vertices[:, None] - path, axis=2).min(axis=1)
    assert gaps.max() < 0.0101
    assert np.linalg.norm(vertices[4 * 14 :] - 0, axis=1).size  # caps and rings
    assert body.area == pytest.approx(2 * np.pi * 0.01 * 0.102 + 4 * np.pi * 0.01**2, rel=0.12)
    assert tube(path, np.full(20, 0.05))[0][:, 2].min() == 0.0  # the table's height
    still, _ = tube(np.zeros((5, 3)), np.full(5, 0.01))
    assert np.isfinite(still).all()


def test_the_rim_is_coloured_all_around():
    session = Session(Choices(object=example("bracket")))
    points, colours = rim_segments(session.rim, session.choices.object.corners)
    assert len(points) == len(colours) > 50
    assert colours.min() >= 0
    assert colours.max() <= 255
    np.testing.assert_allclose(np.linalg.norm(np.diff(points[:, :, :2], axis=1), axis=-1).max(), 0, atol=0.03)
    assert len(edges_of(example("bracket"))) > len(edges_of(example("disc"))) / 10 > 0


# --- the page ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def served():
    pytest.importorskip("viser")
    from foretrace.studio.server import StudioServer

    server = StudioServer(port=0)
    yield server
    server.stop()


def visit(served, link: str = ""):
    from studio_visitor import Visitor

    visitor = Visitor(served.address, link)
    visitor.look(lambda: "/rim" in visitor.nodes, 20)
    visitor.set("play", False)
    return visitor


def test_pages_of_visitors_who_left_at_once_make_room(served):
    closed = []
    served.pages[10_000] = SimpleNamespace(close=lambda: closed.append(True))
    served._come(SimpleNamespace(client_id=10_001))  # left before it was dealt with
    assert closed == [True]
    assert served.pages == {}


def test_a_host_that_is_not_here_is_refused():
    from foretrace.studio.server import StudioServer

    with pytest.raises(ForetraceError, match=r"cannot listen at 192\.0\.2\.1 .*: give another --host"):
        StudioServer(host="192.0.2.1", port=0)


def test_a_visitor_drags_the_contact_and_sees_the_futures(served):
    with visit(served) as visitor:
        assert "levered" in visitor.html
        place = visitor.value("place")
        visitor.drag(-0.05, -0.2)
        visitor.look(lambda: visitor.value("place") != place)
        turned = visitor.nodes["/grip"]["position"]
        assert np.linalg.norm(np.array(turned[:2]) - [-0.05, -0.2]) < 0.12
        visitor.drag(turned[0] + 0.02, turned[1], modifier="shift")
        visitor.look(lambda: visitor.value("direction") != 0)


def test_each_visitor_has_a_state_of_their_own(served):
    with visit(served) as first, visit(served, "object:racket,friction:unknown,goal:move") as second:
        second.look(lambda: second.value("example") == "racket")
        assert second.label(second.find("friction, table")) == "friction, table: unknown"
        assert second.value("goal") == "move"
        first.set("example", "book")
        first.look(seconds=0.5)
        assert second.value("example") == "racket"


def test_a_visitor_draws_an_outline_and_mistakes_are_told(served):
    with visit(served) as visitor:
        visitor.click("draw an outline")
        visitor.look(lambda: "click the corners" in visitor.html)
        visitor.click("finish the outline")
        visitor.look(lambda: "at least 3" in visitor.html or "corners" in visitor.html.split("click")[0])
        for corner in ((0.0, 0.0), (0.1, 0.0), (0.1, 0.09)):
            visitor.press(*corner)
        visitor.look(lambda: "3 corners" in visitor.html)
        visitor.click("finish the outline")
        visitor.look(lambda: "levered" in visitor.html)
        assert visitor.value("example") == "your own"
        for _ in range(2):  # the former object is chosen, too
            visitor.click("draw an outline")
            visitor.look(lambda: "click the corners" in visitor.html)
            visitor.set("example", "book")  # gives the drawing up
            visitor.look(lambda: "levered" in visitor.html)
        visitor.set("x y [m]", "0 0\nx")
        visitor.click("use these corners")
        visitor.look(lambda: "corners.txt, line 2" in visitor.html)


def test_a_visitor_gives_a_photograph(served):
    with visit(served) as visitor:
        visitor.click("example photograph")
        visitor.look(lambda: visitor.value("example") == "your own")
        visitor.look(lambda: visitor.controls[visitor.find("photograph", "GuiImageMessage")]["visible"])
        assert visitor.value("height") == 18
        assert visitor.value("contact [px]") == "565 209"
        visitor.set("object told by", "grabcut")
        visitor.click("find the object")
        visitor.look(lambda: "grabcut needs a box" in visitor.html)
        visitor.upload("choose a camera", "other.json", b"{}")
        visitor.look(lambda: "camera: other.json" in visitor.texts())
        visitor.set("object told by", "threshold")
        visitor.click("find the object")
        visitor.look(lambda: "other.json" in visitor.html)
        visitor.set("example", "book")
        visitor.look(lambda: not visitor.controls[visitor.find("photograph", "GuiImageMessage")]["visible"])


def test_large_files_are_dropped_while_they_arrive(served):
    with visit(served) as visitor:
        visitor.upload("choose a photograph", "large.jpg", b"", size=9 << 20)
        visitor.look(lambda: "large.jpg has 9.0 MB: give at most 8 MB" in visitor.html)
        visitor.upload("choose a photograph", "liar.jpg", bytes(9 << 20), size=10, parts=2)
        visitor.look(lambda: "liar.jpg has 9.0 MB" in visitor.html)
        page = list(served.pages.values())[-1]
        assert not page._client.gui._current_file_upload_states
        for k in range(5):
            visitor.upload("choose a photograph", f"half{k}.jpg", b"1", size=2, parts=2)
        visitor.look(lambda: "4 files are on their way already: send half4.jpg" in visitor.html)
        page._client.gui._current_file_upload_states.clear()
        visitor.upload("choose a photograph", "small.jpg", b"1")
        visitor.look(lambda: "photo: small.jpg" in visitor.texts())


def test_a_visitor_sees_the_arm(served):
    with visit(served) as visitor:
        assert "/arm/part0" not in visitor.nodes
        visitor.set("arm", True)
        visitor.look(lambda: "position" in visitor.nodes.get("/arm/part9", {}))
        before = visitor.nodes["/arm/part9"]["position"], visitor.nodes["/arm"]["position"]
        visitor.set("time [s]", 2.0)
        visitor.look(lambda: visitor.nodes["/arm/part9"]["position"] != before[0])
        visitor.drag(-0.05, -0.2)
        visitor.look(lambda: visitor.nodes["/arm"]["position"] != before[1])
        visitor.set("arm", False)
        visitor.look(lambda: visitor.nodes["/arm"]["visible"] is False)


def test_a_visitor_plans_and_simulates(served):
    with visit(served, "goal:tumble,along:0.7") as visitor:
        visitor.click("simulate it")
        visitor.look(
            lambda: "region held 1 of 1" in visitor.texts() or "region held 0 of 1" in visitor.texts(), 20
        )
        visitor.click("plan")
        visitor.look(lambda: "reached with a probability" in visitor.texts(), 60)
        place = visitor.value("place")
        visitor.set("look at", "alternative 2")
        visitor.look(lambda: visitor.value("place") != place)


def test_a_visitor_watches_and_saves(served):
    with visit(served) as visitor:
        visitor.set("what goes wrong", "freeze")
        visitor.click("watch")
        visitor.look(lambda: "score" in visitor.verdict, 20)
        visitor.set("play", False)
        visitor.look(seconds=0.3)
        visitor.set("time [s]", visitor.controls[visitor.find("time [s]")]["max"])
        visitor.look(lambda: "In truth" in visitor.verdict)
        assert "tracker frozen" in visitor.verdict
        visitor.click("the same in Python")
        visitor.look(lambda: "foretrace_lines.py" in visitor.downloads)
        visitor.set("goal", "move")
        visitor.look(lambda: "goal:move" in visitor.value("link"))


def test_a_choice_that_is_made_while_something_is_drawn_is_kept(served):
    with visit(served) as visitor:
        page, drawn = list(served.pages.values())[-1], Event()
        page.act(drawn.wait)
        visitor.set("goal", "move")
        visitor.look(seconds=0.5)
        page.controls.show_choices(page.session.choices)  # as a picture of the former choices does
        drawn.set()
        visitor.look(lambda: "goal:move" in visitor.value("link"))


def test_choices_are_taken_in_their_order(served):
    with visit(served) as visitor:
        page, drawn = list(served.pages.values())[-1], Event()
        page.act(drawn.wait)
        visitor.set("example", "disc")
        visitor.click("draw an outline")
        visitor.set("example", "book")  # gives the drawing up
        visitor.look(seconds=0.5)
        drawn.set()
        visitor.look(lambda: "object:book" in visitor.value("link"))


def test_work_is_done_in_its_order_and_goes_on_after_a_fault(capfd):
    queue, begin, last, done = WorkQueue(), Event(), Event(), []

    def work(number: int) -> None:
        begin.wait()
        done.append((number, queue.is_latest(number)))
        if number == 2:
            raise RuntimeError("a fault of the second")
        if number == 4:
            last.set()

    for _ in range(4):
        queue.add(work)
    begin.set()
    assert last.wait(5)
    queue.end()
    queue.add(work)
    assert done == [(1, False), (2, False), (3, False), (4, True)]
    assert "RuntimeError: a fault of the second" in capfd.readouterr().err


def test_a_link_that_cannot_be_read_is_told(served):
    with visit(served, "along:far") as visitor:
        assert "the link says along:&#x27;far&#x27;" in visitor.html


def test_a_page_ends_with_its_visitor(served):
    with visit(served) as visitor:
        page = list(served.pages.values())[-1]
        visitor.look(seconds=0.1)
    for thread in (page._player, *page._work._thread._threads):
        thread.join(5)
        assert not thread.is_alive()
    assert page not in served.pages.values()


def test_without_the_extra_the_command_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "foretrace.studio.server", raising=False)
    assert cli.main(["studio"]) == 2
    assert (
        "this needs viser, which is not installed: pip install 'foretrace[studio]'" in capsys.readouterr().err
    )


def test_a_port_that_there_is_not_is_refused(capsys):
    pytest.importorskip("viser")
    assert cli.main(["studio", "--port", "70000"]) == 2
    assert "--port is 70000" in capsys.readouterr().err
