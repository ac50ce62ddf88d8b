"""Colours, lines and type of all pictures.

The colours are Okabe and Ito's, which colour-blind readers can tell apart; line styles differ too.
"""

import zlib
from typing import Any, Literal

import matplotlib as mpl
from matplotlib.figure import Figure

from foretrace.interactions.record import Outcome

INK = "#22262e"
GREY = "#8b93a1"
TRUTH_COLOR = "#009e73"
PREDICTION_COLORS = ("#d55e00", "#0072b2", "#cc79a7", "#e69f00")
PREDICTION_LINES = ("--", "-.", ":", (0, (5, 1, 1, 1)))
OBJECT_COLOR = "#dde6f0"
OBJECT_EDGE = "#4a6078"
TOOL_COLOR = "#6b5b4b"
SUPPORT_COLOR = "#a3458f"
OUTCOME_COLORS: dict[str, str] = {
    Outcome.LEVERED: "#009e73",
    Outcome.SLIPPED: "#e69f00",
    Outcome.TUMBLED: "#d55e00",
    Outcome.ROLLED: "#cc79a7",
    Outcome.MISSED: "#8b93a1",
    Outcome.FAILED: "#22262e",
}
OTHER_COLORS = ("#009e73", "#e69f00", "#d55e00", "#cc79a7", "#0072b2")


def outcome_color(outcome: str) -> str:
    """Colour of an outcome of any action; those of the lever-up have their own."""
    return OUTCOME_COLORS.get(outcome) or OTHER_COLORS[zlib.crc32(outcome.encode()) % len(OTHER_COLORS)]


STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.8,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "figure.facecolor": "white",
}
CM = 100.0
DPI = 150

styled = mpl.rc_context(STYLE)
"""Decorator of functions that draw in this style."""


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """An empty picture [inches] whose axes make room for labels and legends, unless they have places of their own."""
    return Figure(figsize=(width, height), dpi=DPI, layout=layout)


def headline(fig: Figure, title: str) -> None:
    """Title of a whole picture."""
    fig.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
