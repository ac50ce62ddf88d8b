"""Planning: the action whose imagined outcome suits a goal best.

It knows the contract of imaginers (`foretrace.imagined.Imaginer`), not who implements it.
"""

from foretrace.planning import goals
from foretrace.planning.goals import Goal
from foretrace.planning.motions import Motions
from foretrace.planning.plan import PlanConfig, plan
from foretrace.planning.result import Alternative, Plan, RimCost, Stage
from foretrace.planning.sequence import Execution, Sequence, World, execute_sequence, plan_sequence

__all__ = [
    "Alternative",
    "Execution",
    "Goal",
    "Motions",
    "Plan",
    "PlanConfig",
    "RimCost",
    "Sequence",
    "Stage",
    "World",
    "execute_sequence",
    "goals",
    "plan",
    "plan_sequence",
]
