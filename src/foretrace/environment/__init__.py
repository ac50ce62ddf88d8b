"""A Gymnasium environment: see an object from above, choose lever-ups, and be rewarded by a goal (``foretrace[gym]``).

Importing this module registers ``foretrace/LeverUp-v1``; where the package is installed, Gymnasium does so itself.
"""

import gymnasium

from foretrace.environment.coding import BROKEN, CONE, REFUSED, observed_context, observed_view
from foretrace.environment.imagined_cost import ImaginedCost
from foretrace.environment.lever_up import LeverUpEnv

__all__ = [
    "BROKEN",
    "CONE",
    "ENVIRONMENT",
    "REFUSED",
    "ImaginedCost",
    "LeverUpEnv",
    "observed_context",
    "observed_view",
    "register_environments",
]

ENVIRONMENT = "foretrace/LeverUp-v1"


def register_environments() -> None:
    """Enter the environment into Gymnasium's registry, unless it is there."""
    if ENVIRONMENT not in gymnasium.registry:
        gymnasium.register(ENVIRONMENT, entry_point="foretrace.environment:LeverUpEnv")


register_environments()
