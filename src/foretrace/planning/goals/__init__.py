"""Goals: what is to happen to an object, as a cost of its futures, and what must not happen.

A cost has no unit: 1 stands for 10 cm, or for a quarter turn. The lower, the better; 0 is a goal that is reached, or,
where something shall be as large as possible, an object that is left as it is. All lies in the object's frame at rest.
"""

from foretrace.planning.goals.base import (
    ANGLE,
    GOALS,
    LENGTH,
    Constraint,
    Goal,
    Own,
    Total,
    as_goal,
    describe,
)
from foretrace.planning.goals.learning import Learn
from foretrace.planning.goals.lifting import KeepUpright, Lift, Tilt, Tumble, TurnOver
from foretrace.planning.goals.moving import Avoid, Move, MoveTo, SlideOff, Turn

__all__ = [
    "ANGLE",
    "GOALS",
    "LENGTH",
    "Avoid",
    "Constraint",
    "Goal",
    "KeepUpright",
    "Learn",
    "Lift",
    "Move",
    "MoveTo",
    "Own",
    "SlideOff",
    "Tilt",
    "Total",
    "Tumble",
    "Turn",
    "TurnOver",
    "as_goal",
    "describe",
]
