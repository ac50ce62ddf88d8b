"""Commands that serve a page or an interface: studio, serve."""

from pathlib import Path

from foretrace.errors import StudioError
from foretrace.studio.heaps import share_heaps


def studio(
    host: str = "127.0.0.1",
    port: int = 8080,
    data: Path | None = None,
    at: str = "",
    dark: bool = False,
    export: Path | None = None,
    onnxruntime_web: Path | None = None,
) -> None:
    """Try lever-ups in the browser: draw an object, drag the screwdriver round it, plan. Needs foretrace[sim,studio].

    Every visitor has a page of their own. By default it can be reached from this machine alone.

    With --export nothing is served: a folder is written whose page predicts in the browser, without a server.

    Args:
        host: Address to listen at; 0.0.0.0 lets other machines in, whoever they are.
        port: Port to listen at; the next free one is taken.
        data: Data set whose objects can be chosen.
        at: What is chosen at first, as the end of a link that the studio makes.
        dark: Dark page.
        export: Folder to write a page to that needs no server: draw, drag, futures, regions.
        onnxruntime_web: For --export: folder of the unpacked npm package onnxruntime-web; by default npm fetches it.
    """
    if export is not None:
        from foretrace.studio.static_page import write_static_page

        print(write_static_page(export, onnxruntime_web))
        return
    if onnxruntime_web is not None:
        raise StudioError(
            f"--onnxruntime-web {onnxruntime_web} is of no use without --export: add it, or leave it out"
        )
    check_port(port)
    share_heaps()
    from foretrace.interactions.dataset import Dataset
    from foretrace.studio.choices import Choices
    from foretrace.studio.server import StudioServer

    choices = Choices.from_text(at)
    served = StudioServer(host, port, choices, None if data is None else Dataset.open(data), dark)
    try:
        print(f"http://{served.address}", flush=True)
        served.wait()
    finally:
        served.stop()


def serve(host: str = "127.0.0.1", port: int = 8000) -> None:
    """Serve predictions, plans and monitors over HTTP. Needs foretrace[studio].

    The page at / lists what can be asked, /openapi.json describes it. It asks for no password: by default it can be
    reached from this machine alone.

    Args:
        host: Address to listen at; 0.0.0.0 lets other machines in, whoever they are.
        port: Port to listen at; 0: any that is free.
    """
    check_port(port)
    share_heaps()
    from foretrace.studio.service import serve

    serve(host, port)


def check_port(port: int) -> None:
    """Refuse a port that there is not.

    Raises:
        StudioError: Naming it.
    """
    if not 0 <= port <= 65535:
        raise StudioError(f"--port is {port}: give a number from 0 to 65535")
