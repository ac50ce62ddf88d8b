"""The service over HTTP: predictions, plans and monitors."""

import json
import sys

import numpy as np
import pytest

import foretrace as ft
from foretrace import cli
from foretrace.geometry import transform_points
from foretrace.predictor import load_imaginer

pytest.importorskip("fastapi")
pytest.importorskip("httpx2")

from fastapi.testclient import TestClient

from foretrace.studio import watches
from foretrace.studio.bodies import PredictBody
from foretrace.studio.service import MOST_BYTES, imagine, make_service
from foretrace.studio.session import Session

CORNERS = [[0.09, 0.0], [0.02, 0.08], [-0.07, 0.05], [-0.08, -0.04], [0.03, -0.08]]
OBJECT = {"kind": "prism", "corners": CORNERS}
KNOWN = {"object": OBJECT, "action": {"contact": [0.0, 0.08]}}


@pytest.fixture(scope="module")
def client():
    return TestClient(make_service(), raise_server_exceptions=True)


def test_a_prediction_is_the_librarys(client):
    answer = client.post("/predict", json=KNOWN | {"context": {"friction": 0.7}, "level": 0.5})
    assert answer.status_code == 200
    told = answer.json()
    obj = ft.Prism(CORNERS)
    action = ft.LeverUp.nearest(obj, (0.0, 0.08))
    com = transform_points(action.T_action_object, obj.mass_properties(1.0).com[None])[0]
    direct = load_imaginer().imagine(
        ft.TopDownView.of(obj, action), action, context={"friction": 0.7}, com=com
    )
    assert told == {"times": direct.times.tolist()} | json.loads(json.dumps(direct.to_dict(0.5, 3)))
    assert len(told["futures"]) == 3


def test_an_object_that_is_sent_again_is_not_made_again():
    first, again, other = (
        PredictBody.model_validate(KNOWN | {"object": OBJECT | {"height": height}}).make_object()
        for height in (0.02, 0.02, 0.03)
    )
    assert first is again
    assert other.height == 0.03


def test_a_plan_can_be_opened_again(client, tmp_path):
    goal = {"name": "move", "direction": [1.0, 0.0]}
    answer = client.post("/plan", json={"object": OBJECT, "goal": goal, "check": 0})
    (tmp_path / "plan.json").write_text(answer.text)
    plan = ft.Plan.open(tmp_path / "plan.json")
    assert plan.goal == "Move(direction=(1, 0))"
    direct = ft.plan(ft.Prism(CORNERS), ft.goals.Move((1, 0)), config=ft.PlanConfig(check=0))
    np.testing.assert_allclose(plan.action.contact, direct.action.contact, atol=1e-6)


def test_a_monitor_watches_an_execution(client):
    begun = client.post("/monitors", json=KNOWN | {"worlds": 16})
    assert begun.status_code == 201
    id = begun.json()["id"]
    obj = ft.Prism(CORNERS)
    effect = ft.simulate(obj, ft.LeverUp.nearest(obj, (0.0, 0.08)), embodiment="tool").effect
    samples = [
        {"t": float(t), "pose": pose.tolist()}
        for t, pose in zip(effect.times, effect.pose_trajectory, strict=True)
    ]
    assert client.get(f"/monitors/{id}").json() is None
    first = client.post(f"/monitors/{id}/samples", json={"samples": samples[:30]}).json()
    assert (first["alarm"], first["message"]) == (False, "as imagined")
    held = [{"t": each["t"], "pose": samples[29]["pose"]} for each in samples[30:]]
    last = client.post(f"/monitors/{id}/samples", json={"samples": held}).json()
    assert last["alarm"]
    assert last["cause"]
    assert client.get(f"/monitors/{id}").json() == last
    assert client.delete(f"/monitors/{id}").status_code == 204
    assert client.get(f"/monitors/{id}").status_code == 404


REFUSED = {
    "object.prism.corners: List should have at least 3 items": (
        "/predict",
        KNOWN | {"object": OBJECT | {"corners": [[0, 0]]}},
    ),
    "corner": ("/predict", KNOWN | {"object": OBJECT | {"corners": [[0, 0], [0, 0], [0, 0]]}}),
    "object: Input tag 'spoon'": ("/predict", KNOWN | {"object": {"kind": "spoon"}}),
    "action.contact.0: Input should be a valid number": (
        "/predict",
        KNOWN | {"action": {"contact": ["x", 0]}},
    ),
    "lies 100000 m away": ("/predict", KNOWN | {"action": {"contact": [1e5, 0], "direction": [1, 0]}}),
    "direction [0.0, 0.0] has no length": (
        "/predict",
        KNOWN | {"action": {"contact": [0, 0.06], "direction": [0, 0]}},
    ),
    "sweep = 9.0 is outside": ("/predict", KNOWN | {"action": {"contact": [0.0, 0.08], "sweep": 9}}),
    "colour: Extra inputs are not permitted": ("/predict", KNOWN | {"colour": "red"}),
    "level: Input should be less than": ("/predict", KNOWN | {"level": 1.0}),
    "the goal tilt needs its angle": ("/plan", {"object": OBJECT, "goal": {"name": "tilt"}}),
    "the goal lift has no angle": ("/plan", {"object": OBJECT, "goal": {"name": "lift", "angle": 1}}),
    "edge": ("/plan", {"object": OBJECT, "goal": {"name": "turn-over"}}),
    "false_alarms is 0.9": ("/monitors", KNOWN | {"worlds": 0, "false_alarms": 0.9}),
    "rest: the quaternion": ("/monitors", KNOWN | {"worlds": 0, "rest": [0, 0, 0, 0, 0, 0, 0]}),
}


@pytest.mark.parametrize("message", REFUSED)
def test_mistakes_are_told_in_one_line(client, message):
    path, body = REFUSED[message]
    answer = client.post(path, json=body)
    assert answer.status_code == 422
    assert message in answer.json()["detail"]
    assert "\n" not in answer.json()["detail"]


def test_bodies_are_bounded_and_have_to_be_json(client):
    long = client.post("/predict", content=b"1" * (MOST_BYTES + 1))
    assert (long.status_code, long.json()["detail"][:28]) == (413, "the body is longer than 1024")
    chunked = client.post("/predict", content=(b"1" * 65536 for _ in range(17)))
    assert chunked.status_code == 413
    broken = client.post("/predict", content=b"{", headers={"content-type": "application/json"})
    assert (broken.status_code, broken.json()["detail"][:22]) == (400, "the body is no JSON: s")
    unnamed = client.post("/predict", content=json.dumps(KNOWN))  # as curl -d without the header
    assert unnamed.status_code == 422
    assert unnamed.json()["detail"].endswith("add the header Content-Type: application/json")
    infinite = client.post(
        "/predict",
        content=json.dumps(KNOWN | {"level": np.nan}),
        headers={"content-type": "application/json"},
    )
    assert infinite.status_code == 422


def test_a_monitor_knows_its_context(client, monkeypatch):
    beliefs = []
    monkeypatch.setattr(
        "foretrace.studio.service.imagine",
        lambda obj, action, context: beliefs.append(context) or imagine(obj, action, context),
    )
    for context in ({"friction": 0.7, "contact_error": 0}, "unknown", None):
        assert client.post("/monitors", json=KNOWN | {"worlds": 8, "context": context}).status_code == 201
    told, unknown, nothing = beliefs
    assert told.ranges["friction"] == (0.7, 0.7)
    assert told.ranges["contact_left"] == (0, 0)
    assert told.ranges["density"] == unknown.ranges["density"] == ft.Belief().ranges["density"]
    assert unknown.ranges == nothing.ranges == ft.Belief().ranges
    wrong = client.post("/monitors", json=KNOWN | {"context": {"contact_error": 0.002}})
    assert "context contact_error is 0.002" in wrong.json()["detail"]


def test_monitors_are_bounded_in_number_and_life(monkeypatch):
    now, monitor = [0.0], ft.Monitor(Session().imagined)
    kept = watches.Watches(lambda: now[0])
    monkeypatch.setattr(watches, "MOST", 2)
    first, second = kept.begin(monitor), kept.begin(monitor)
    with pytest.raises(watches.BusyError, match="there are 2 monitors already"):
        kept.begin(monitor)
    now[0] = watches.LIFE - 1
    kept.find(second)
    now[0] = watches.LIFE + 1
    with pytest.raises(watches.UnknownWatchError):
        kept.find(first)
    kept.begin(monitor)
    assert len(kept) == 2
    kept.end(second)
    watch = kept.find(kept.begin(monitor))
    watch.taken = watches.MOST_SAMPLES
    with pytest.raises(ft.ForetraceError, match="10000 samples"):
        watch.update(0.0, None)


def test_the_page_and_the_description_need_nothing_from_elsewhere(client):
    page, schema = client.get("/"), client.get("/openapi.json").json()
    assert "POST /predict" in page.text
    assert "http" not in page.text
    assert set(schema["paths"]) == {
        "/predict",
        "/plan",
        "/monitors",
        "/monitors/{id}",
        "/monitors/{id}/samples",
    }


def test_every_property_and_answer_is_described(client):
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    bare = [
        f"{name}.{key}"
        for name, each in schemas.items()
        if name not in ("HTTPValidationError", "ValidationError")
        for key, value in each["properties"].items()
        if not value.get("description")
    ]
    assert bare == []
    told = client.post("/predict", json=KNOWN).json()
    assert set(told) == set(schemas["Predicted"]["properties"])
    assert set(told["futures"][0]) == set(schemas["FutureTold"]["properties"])
    plan = client.post("/plan", json={"object": OBJECT, "goal": {"name": "turn", "angle": 0.2}, "check": 0})
    assert set(schemas["Planned"]["properties"]) <= set(plan.json())
    id = client.post("/monitors", json=KNOWN | {"worlds": 0}).json()["id"]
    verdict = client.post(f"/monitors/{id}/samples", json={"samples": [{"t": 0, "pose": None}]}).json()
    assert set(verdict) == set(schemas["VerdictTold"]["properties"])


def test_without_the_extra_the_command_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "fastapi", None)
    monkeypatch.delitem(sys.modules, "foretrace.studio.service")
    assert cli.main(["serve"]) == 2
    assert (
        "this needs fastapi, which is not installed: pip install 'foretrace[studio]'"
        in capsys.readouterr().err
    )


def test_an_address_that_is_taken_is_refused(capsys):
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert cli.main(["serve", "--port", str(port)]) == 2
    assert f"cannot listen at 127.0.0.1:{port}: give another --host or --port" in capsys.readouterr().err
