"""Planning: the action whose imagined outcome suits a goal best.

It knows the contract of imaginers (`foretrace.imagined.Imaginer`), not who implements it.
"""

from foretrace.planning import goals
from foretrace.planning.goals import Goal
from foretrace.planning.motions import Motions
from foretrace.planning.plan import PlanConfig, plan
from foretrace.planning.result import Alternative, Plan, RimCost, Stage

__all__ = ["Alternative", "Goal", "Motions", "Plan", "PlanConfig", "RimCost", "Stage", "goals", "plan"]
