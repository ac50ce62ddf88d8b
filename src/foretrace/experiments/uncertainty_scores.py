"""Proper scores of motions drawn at random: of a predictor's own, and of a Gaussian of constant width to beat.

Gneiting and Raftery, 2007, "Strictly proper scoring rules, prediction, and estimation": whoever says what they believe
has the best score to expect. A forecast without any spread scores its mean error.
"""

from collections.abc import Iterator

import numpy as np
import scoringrules
import torch
from jaxtyping import Bool, Float

from foretrace.predictor.mixture import Mixture

FORECASTS = {
    "mixture": "the predictor's futures",
    "gaussian": "constant Gaussian, most likely width",
    "sharp": "constant Gaussian, width of the best CRPS",
}
"""Whose samples are scored, in words."""
SCORES = {
    "energy_full": "Energy score, whole motion [cm]",
    "energy_final": "Energy score, final position [cm]",
    "crps": "CRPS, per coordinate [cm]",
}
"""Scores, in words; less is better."""
WIDTHS = np.geomspace(1e-5, 1.0, 201)
"""Standard deviations among which that of the best CRPS is sought [m]."""
CM = 100.0


def constant_deviations(
    off: Float[np.ndarray, "batch time 3"], valid: Bool[np.ndarray, "batch time"]
) -> dict[str, Float[np.ndarray, " time"]]:
    """Standard deviations of coordinates, sample by sample, that fit errors best [m].

    Args:
        off: Errors of the validation part [m].
        valid: Which of them count. A sample that none has gets the deviation of the one before.

    Returns:
        ``gaussian``: the most likely one, the root mean square. ``sharp``: the one with the least mean CRPS, less
        impressed by a few large errors.
    """
    count = valid.sum(axis=0)
    last = np.maximum.accumulate(np.where(count, np.arange(len(count)), 0))
    weight = valid / np.maximum(count, 1)
    square = np.sum(np.where(valid[..., None], off, 0.0) ** 2, axis=2) / 3
    found = np.empty((len(WIDTHS), len(count)))
    for each, width in zip(found, WIDTHS, strict=True):
        crps = scoringrules.crps_normal(np.where(valid[..., None], off, 0.0), 0.0, width, backend="numpy")
        each[:] = (np.mean(crps, axis=2) * weight).sum(axis=0)
    likely = np.sqrt((square * weight).sum(axis=0))
    return {"gaussian": likely[last], "sharp": WIDTHS[found.argmin(axis=0)][last]}


def draw(
    mixture: Mixture,
    com: Float[np.ndarray, "batch time 3"],
    deviations: dict[str, Float[np.ndarray, " time"]],
    num: int,
    seed: int,
) -> Iterator[tuple[str, Float[np.ndarray, "batch num time 3"]]]:
    """Samples of each of `FORECASTS`, by name.

    Args:
        mixture: What the predictor says.
        com: Its most probable motions [m], about which the constant Gaussians lie. Errors grow along a motion and do
            not jitter: one draw for each coordinate shifts all samples, each by its own deviation.
        deviations: As from `constant_deviations`.
        num: Motions for each interaction.
        seed: Seed of the draw.
    """
    generator = torch.Generator().manual_seed(seed)
    yield "mixture", mixture.sample(num, generator)[..., :3].double().cpu().numpy()
    z = np.random.default_rng(seed).standard_normal((len(com), num, 1, 3))
    for name, deviation in deviations.items():
        yield name, com[:, None] + z * deviation[:, None]


def score(
    drawn: Float[np.ndarray, "batch num time 3"],
    com: Float[np.ndarray, "batch time 3"],
    valid: Bool[np.ndarray, "batch time"],
) -> dict[str, Float[np.ndarray, " batch"]]:
    """`SCORES` of samples [cm], one number per interaction; the estimates are not biased by how many samples there are.

    Args:
        drawn: Motions drawn at random [m].
        com: What happened [m].
        valid: The samples that count. Motions are as far apart as the root mean square over them.
    """
    found = {name: np.empty(len(com)) for name in SCORES}
    for row, (said, truth, mine) in enumerate(zip(drawn, com, valid, strict=True)):
        said, truth = CM * said[:, mine], CM * truth[mine]  # (num, time, 3), (time, 3)
        motions, motion = (each / len(truth) ** 0.5 for each in (said.reshape(len(said), -1), truth.ravel()))
        found["energy_full"][row] = _energy(motions, motion)
        found["energy_final"][row] = _energy(said[:, -1], truth[-1])
        crps = scoringrules.crps_ensemble(truth, said, m_axis=0, estimator="pwm", backend="numpy")
        found["crps"][row] = np.mean(crps)
    return found


def _energy(said: Float[np.ndarray, "num dims"], truth: Float[np.ndarray, " dims"]) -> float:
    return float(np.asarray(scoringrules.es_ensemble(truth, said, estimator="fair", backend="numpy")))
