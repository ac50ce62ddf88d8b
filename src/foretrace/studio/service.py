"""Predictions, plans and monitors over HTTP."""

from collections.abc import Mapping
from html import escape
from threading import BoundedSemaphore
from typing import Any

import msgspec
import numpy as np
import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import foretrace
from foretrace.errors import ForetraceError, StudioError
from foretrace.geometry import transform_points
from foretrace.imagined import Belief, ImaginedEffect
from foretrace.imagined.belief import EXECUTION
from foretrace.imagined.context import CONSTANTS, EXACT, Context, given_context, told_of
from foretrace.interactions.topdown import TopDownView
from foretrace.monitoring import Monitor, Verdict
from foretrace.objects import ObjectModel, Prism
from foretrace.planning import plan
from foretrace.studio.answers import Begun, Planned, Predicted, Refused, VerdictTold
from foretrace.studio.bodies import ActionBody, MonitorBody, PlanBody, PredictBody, SamplesBody
from foretrace.studio.session import TWIN, learned
from foretrace.studio.watches import LIFE, BusyError, UnknownWatchError, Watches
from foretrace.twin import TwinImaginer

MOST_BYTES = 1 << 20
"""Longest body of a request."""
MOST_CONNECTIONS = 64
"""Connections at once, at most."""
MOST_PLANS, PATIENCE = 2, 20.0
"""Plans that are worked out at once; how long others wait for their turn [s]."""
JSON_HEADER = "Content-Type: application/json"
ABOUT = "Predict how an object will move before a robot touches it, choose where to lever it, and watch the execution."


REFUSALS: dict[int | str, dict[str, Any]] = {
    status: {"model": Refused, "description": text}
    for status, text in (
        (400, "The body is no JSON."),
        (413, f"The body is longer than {MOST_BYTES >> 20} MB."),
        (422, "Something in it cannot be used."),
        (503, "Too many at once."),
    )
}
UNKNOWN: dict[int | str, dict[str, Any]] = {
    404: {"model": Refused, "description": "There is no such monitor."}
}


class BodyLimit:
    """Refuses bodies that are too long before anything looks at them."""

    def __init__(self, app: ASGIApp, most: int = MOST_BYTES) -> None:
        self.app, self.most = app, most

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, with its body, or refuse it."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        body = b""
        while True:
            message = await receive()
            if message["type"] != "http.request":
                return
            body += message.get("body", b"")
            if len(body) > self.most:
                refused = f"the body is longer than {self.most >> 10} kB: send less"
                await JSONResponse({"detail": refused}, 413)(scope, receive, send)
                return
            if not message.get("more_body"):
                break
        whole: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def again() -> Message:
            return whole.pop() if whole else await receive()

        await self.app(scope, again, send)


def make_service() -> FastAPI:
    """The service, as an ASGI application."""
    app = FastAPI(
        title="foretrace", version=foretrace.__version__, description=ABOUT, docs_url=None, redoc_url=None
    )
    app.add_middleware(BodyLimit)
    _refuse(app)
    _add_predictions(app)
    _add_monitors(app, Watches())

    @app.get("/", include_in_schema=False)
    def page() -> HTMLResponse:
        return HTMLResponse(describe(app.openapi()))

    return app


def serve(host: str, port: int) -> None:
    """Serve until Ctrl-C.

    Raises:
        StudioError: The address cannot be listened at.
    """
    learned()
    config = uvicorn.Config(
        make_service(),
        host,
        port,
        log_level="error",
        limit_concurrency=MOST_CONNECTIONS,
        timeout_keep_alive=30,
    )
    server = uvicorn.Server(config)
    try:
        socket = config.bind_socket()
    except (OSError, SystemExit):
        raise StudioError(f"cannot listen at {host}:{port}: give another --host or --port") from None
    print(f"http://{host}:{socket.getsockname()[1]}", flush=True)
    server.run([socket])


def _refuse(app: FastAPI) -> None:
    """How errors are told: in one line, each."""

    @app.exception_handler(ForetraceError)
    def mistake(_: Request, error: ForetraceError) -> JSONResponse:
        status = {BusyError: 503, UnknownWatchError: 404}.get(type(error), 422)
        return JSONResponse({"detail": str(error)}, status)

    @app.exception_handler(RequestValidationError)
    def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        if first["loc"] == ("body",) and "json" not in request.headers.get("content-type", ""):
            return JSONResponse(
                {"detail": f"the body is not sent as JSON: add the header {JSON_HEADER}"}, 422
            )
        if first["type"] == "json_invalid":
            return JSONResponse(
                {"detail": "the body is no JSON: send an object as /openapi.json has it"}, 400
            )
        place = ".".join(str(each) for each in first["loc"] if each != "body") or "the body"
        return JSONResponse({"detail": f"{place}: {first['msg']}"}, 422)

    @app.exception_handler(HTTPException)
    def other(_: Request, error: HTTPException) -> JSONResponse:
        return JSONResponse({"detail": error.detail}, error.status_code, error.headers)


def _add_predictions(app: FastAPI) -> None:
    turns = BoundedSemaphore(MOST_PLANS)

    @app.post(
        "/predict",
        responses=REFUSALS,
        response_model=Predicted,
        summary="Predict the effect of a lever-up",
    )
    def predict(body: PredictBody) -> Response:
        """Futures with their probabilities, in the action frame: origin at the contact, x along the action, z up."""
        obj = body.make_object()
        imagined = imagine(obj, body.action, body.context)
        return _json({"times": imagined.times.tolist(), **imagined.to_dict(body.level, body.most_futures)})

    @app.post("/plan", responses=REFUSALS, response_model=Planned, summary="Choose a lever-up for a goal")
    def make_plan(body: PlanBody) -> Response:
        """The best lever-up, as `foretrace plan` writes it to plan.json."""
        obj, goal = body.make_object(), body.goal.make()
        context: Any = body.context
        placed = None if body.T_table_object is None else np.array(body.T_table_object)
        if not turns.acquire(timeout=PATIENCE):
            raise BusyError(f"{MOST_PLANS} plans are being worked out, and others wait: ask again later")
        try:
            twin = (
                TwinImaginer(config=TWIN, object=None if type(obj) is Prism else obj) if body.check else None
            )
            found = plan(
                obj, goal, learned(), context, checker=twin, config=body.config(), T_table_object=placed
            )
        finally:
            turns.release()
        return _json(found.to_dict())


def _add_monitors(app: FastAPI, watches: Watches) -> None:
    @app.post(
        "/monitors",
        status_code=201,
        responses=REFUSALS,
        response_model=Begun,
        summary="Begin to watch a lever-up",
    )
    def begin(body: MonitorBody) -> Begun:
        """A monitor of one execution; give it every tracked sample."""
        obj = body.make_object()
        context: Any = body.context
        if body.worlds:
            context = _belief(context, max(body.worlds, 2))
        imagined = imagine(obj, body.action, context)
        monitor = Monitor(
            imagined,
            body.false_alarms,
            rest=body.rest,
            T_table_action=body.T_table_action,
            clock_error=body.clock_error,
        )
        return Begun(id=watches.begin(monitor), threshold=float(monitor.threshold), life=LIFE)

    @app.post(
        "/monitors/{id}/samples",
        responses=REFUSALS | UNKNOWN,
        response_model=VerdictTold,
        summary="Give it samples",
    )
    def update(id: str, body: SamplesBody) -> Response:
        """The verdict after the last of the samples."""
        watch = watches.find(id)
        with watch.lock:
            verdicts = [watch.update(sample.t, sample.pose) for sample in body.samples]
        return _json(_told(verdicts[-1]))

    @app.get(
        "/monitors/{id}", responses=UNKNOWN, response_model=VerdictTold | None, summary="Its last verdict"
    )
    def look(id: str) -> Response:
        """The last verdict; null before the first sample."""
        verdict = watches.find(id).verdict
        return _json(None if verdict is None else _told(verdict))

    @app.delete("/monitors/{id}", status_code=204, responses=UNKNOWN, summary="End it")
    def end(id: str) -> None:
        """Forget the monitor."""
        watches.end(id)


def imagine(obj: ObjectModel, place: ActionBody, context: Any) -> ImaginedEffect:
    """What is imagined of a lever-up in a context, or over a belief.

    Args:
        obj: The object.
        place: Where and how it is levered.
        context: As of `foretrace.imagined.Imaginer.imagine`.

    Raises:
        ForetraceError: The object or the lever-up cannot be imagined.
    """
    action = place.make(obj)
    com = transform_points(action.T_action_object, obj.mass_properties(1.0).com[None])[0]
    context = told_of(obj, learned().context) if context is None else context
    return learned().imagine(TopDownView.of(obj, action), action, context=context, com=com)


def _belief(context: Context, worlds: int) -> Belief:
    """A belief in which the constants of a context are known.

    Raises:
        PredictionError: A value is out of its range.
    """
    given_context(tuple(CONSTANTS), context, {}, optional=True)
    known = dict(context) if isinstance(context, Mapping) else {}
    exact = dict.fromkeys(EXECUTION, 0.0) if known.pop(EXACT, None) is not None else {}
    return Belief({name: (value, value) for name, value in (known | exact).items()}, worlds=worlds)


def _told(verdict: Verdict) -> dict[str, Any]:
    names = ("time", "alarm", "cause", "score", "threshold", "transition", "outcomes", "causes", "message")
    return {name: getattr(verdict, name) for name in names}


def _json(content: Any) -> Response:
    """An answer; what is not finite is null."""
    return Response(msgspec.json.encode(content), media_type="application/json")


def describe(schema: dict[str, Any]) -> str:
    """A page about the service, which fetches nothing from elsewhere."""
    rows = [
        f"<h2><code>{method.upper()} {escape(path)}</code></h2><p>{escape(each['summary'])}. "
        f"{escape(each.get('description', ''))}</p>"
        for path, methods in schema["paths"].items()
        for method, each in methods.items()
    ]
    style = "body{font:16px/1.5 system-ui;max-width:46em;margin:2em auto;padding:0 1em}h2{font-size:1em}"
    return (
        f"<!doctype html><meta charset=utf-8><title>foretrace</title><style>{style}</style>"
        f"<h1>foretrace {foretrace.__version__}</h1><p>{escape(ABOUT)} Bodies and answers are described in "
        f'<a href="openapi.json">openapi.json</a>.</p>{"".join(rows)}'
    )
