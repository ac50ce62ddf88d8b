"""An own experiment, run with ``python own_experiment.py [FOLDER]``: error against a friction that is not known."""

import sys
from dataclasses import dataclass

import numpy as np

import foretrace as ft
from foretrace.evaluation.experiment import Experiment, Trial
from foretrace.evaluation.run import run_experiment
from foretrace.evaluation.tables import markdown_table
from foretrace.simulation.lever_up import SimulationConfig


@dataclass(frozen=True)
class FrictionTrial(Trial):
    corners: int
    edge: int


@dataclass(frozen=True)
class Friction(Experiment):
    """Error of the shipped predictor against the friction between object and table."""

    frictions: tuple[float, ...] = (0.3, 0.8, 1.2)
    """Coefficients to simulate with."""

    label = "friction"
    summary = "Error against the friction that the predictor does not know."
    trial = FrictionTrial
    needs_folder = False

    def trials(self):
        return [FrictionTrial(corners, edge) for corners in (4, 6) for edge in (0, 1)]

    def identity(self):
        return {"frictions": self.frictions}

    def run(self, trial, folder):
        prism = ft.sample_prism(np.random.default_rng(trial.corners), trial.corners)
        action = ft.LeverUp.at_edge(prism, trial.edge)
        imagined = ft.load_predictor().imagine(ft.TopDownView.of(prism, action)).com_trajectory
        for friction in self.frictions:
            config = SimulationConfig(embodiment="tool", physics=ft.Physics(friction=friction))
            com = ft.simulate_lever_up(prism, action, config).effect.com_trajectory
            n = min(len(com), len(imagined))
            error = 100 * np.linalg.norm(com[:n] - imagined[:n], axis=1).mean()
            yield {"friction": friction, "error_cm": float(error)}

    def summarise(self, rows):
        return {f"{friction:g}": part["error_cm"].mean() for friction, part in rows.groupby("friction")}

    def report(self, summary, rows):
        lines = [[friction, f"{error:.2f}"] for friction, error in summary.items()]
        return "# Friction\n\n" + markdown_table(["Friction", "Error [cm]"], lines) + "\n"


if __name__ == "__main__":
    print(run_experiment(Friction(), sys.argv[1] if len(sys.argv) > 1 else None).report)
