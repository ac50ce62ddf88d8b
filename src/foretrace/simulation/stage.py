"""Surroundings of a recorded object: a lamp with soft shadows, a table with a pattern, the object's colour."""

from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

TableTop = Literal["plain", "wooden", "speckled"]
ObjectColour = Literal["blue", "grey", "brown"]

OBJECT_COLOURS: dict[ObjectColour, tuple[float, float, float]] = {
    "blue": (0.0, 0.45, 0.7),
    "grey": (0.55, 0.54, 0.51),
    "brown": (0.55, 0.4, 0.26),
}
"""Red, green and blue; grey is like the plain table's, brown like the wooden one's."""
PATTERN_PIXELS = 1024
PATTERN_SIDE = 0.5
"""Side of the pattern that is repeated over the table [m]."""
LAMP_DISTANCE = 1.5
"""From the lamp to the table [m]."""
LAMP_SLANT = (0.5, 0.8)
"""Angle of its light from the vertical, drawn from this range [rad]."""
LAMP_RADIUS = 0.12
"""Its size makes shadows soft: that of an object of 2 cm fades over about 4 mm [m]."""
LAMP_POINTS = 8
"""Points of the lamp that are rendered and blended."""
LAMP_COLOUR = (0.42, 0.4, 0.37)
"""A little warmer than the light from all round, so that shadows are a little bluer."""
SHADOW_PIXELS = 4096
"""Side of the map of what the lamp sees."""
SHADOW_REACH = 0.35
"""The lamp casts shadows so far around the contact point, beyond which nothing stands [m]."""


def set_stage(spec: mujoco.MjSpec, table: TableTop, colour: ObjectColour, rng: np.random.Generator) -> None:
    """Paints table and object of a scene.

    Args:
        spec: The scene.
        table: How the table looks.
        colour: The object's colour.
        rng: Draws the table's pattern.
    """
    if table != "plain":
        _paint_table(spec, table_pattern(table, rng))
    if colour != "blue":
        for geom in spec.body("object").geoms:
            if not geom.material:  # markers have one
                geom.rgba = [*OBJECT_COLOURS[colour], 1.0]


def table_pattern(table: TableTop, rng: np.random.Generator) -> UInt8[np.ndarray, "rows columns 3"]:
    """Red, green and blue of a table's pattern, which can be laid beside itself without a seam.

    It is noise of the pattern's wavelengths: long ones along the grain and short ones across it, or short ones alone.
    """
    waves = np.fft.fft2(rng.standard_normal((PATTERN_PIXELS, PATTERN_PIXELS)))
    across, along = np.meshgrid(*[np.fft.fftfreq(PATTERN_PIXELS, 1 / PATTERN_PIXELS)] * 2, indexing="ij")

    def band(rows: float, columns: float) -> np.ndarray:
        kept = np.exp(-((across / rows) ** 2) - (along / columns) ** 2) * ((across != 0) | (along != 0))
        values = np.fft.ifft2(waves * kept).real
        return values / values.std()

    if table == "wooden":
        grain = np.sin(4.0 * band(6.0, 1.5) + 2.0 * band(40.0, 3.0)) + 0.6 * band(120.0, 6.0)
        return _colours(np.array([172.0, 128.0, 84.0]), 0.08 * grain)
    flecks = band(90.0, 90.0)
    return _colours(np.array([176.0, 172.0, 164.0]), 0.16 * (flecks > 1.2) - 0.3 * (flecks < -1.2))


def _colours(mean: Float[np.ndarray, "3"], change: Float[np.ndarray, "rows columns"]) -> np.ndarray:
    return np.clip(np.rint(mean * (1 + change[..., None])), 0, 255).astype(np.uint8)


def _paint_table(spec: mujoco.MjSpec, pattern: UInt8[np.ndarray, "rows columns 3"]) -> None:
    rows, columns = pattern.shape[:2]
    kind = mujoco.mjtTexture.mjTEXTURE_2D
    texture = spec.add_texture(name="table_top", type=kind, width=columns, height=rows, nchannel=3)
    texture.data = pattern.tobytes()
    material = spec.add_material(name="table_top", texuniform=True, texrepeat=[1 / PATTERN_SIDE] * 2)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "table_top"
    geom = spec.geom("table")
    geom.material, geom.rgba = "table_top", [1.0, 1.0, 1.0, 1.0]


def cast_shadows(spec: mujoco.MjSpec, rng: np.random.Generator) -> Float[np.ndarray, "point 3"]:
    """Puts a scene's lamp where objects cast shadows that are seen; returns the points that it shines from [m].

    Args:
        spec: The scene.
        rng: Draws where the lamp stands.
    """
    slant, azimuth = rng.uniform(*LAMP_SLANT), rng.uniform(-np.pi, np.pi)
    towards = np.array([np.sin(slant) * np.cos(azimuth), np.sin(slant) * np.sin(azimuth), np.cos(slant)])
    side = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    # Sunflower seeds: evenly over a disc.
    number = np.arange(LAMP_POINTS) + 0.5
    radius, turn = LAMP_RADIUS * np.sqrt(number / LAMP_POINTS), np.pi * (1 + np.sqrt(5)) * number
    disc = radius * np.array([np.cos(turn), np.sin(turn)])
    lamp = spec.lights[0]
    lamp.pos, lamp.dir = LAMP_DISTANCE * towards, -towards
    lamp.diffuse, lamp.specular, lamp.castshadow = LAMP_COLOUR, [0.0] * 3, True
    lamp.exponent = 0.0
    spec.visual.quality.shadowsize = SHADOW_PIXELS
    spec.visual.map.shadowscale = float(np.rad2deg(np.arctan(SHADOW_REACH / LAMP_DISTANCE)) / lamp.cutoff)
    return LAMP_DISTANCE * towards + disc.T @ [side, np.cross(towards, side)]
