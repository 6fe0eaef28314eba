"""Write fixtures/garden.ply: a procedural scene, small but shaped like a trained one. Run without arguments.

Axes RDF (x right, y down, z forward), units of a meter. The ground is at y = 0; up is -y. Values are rounded to 16
significant bits, so that the last bits of a machine's sine do not show.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsplat_tools.attributes import quaternions
from gsplat_tools.attributes.spherical_harmonics import evaluate_basis
from gsplat_tools.cloud import GaussianCloud, concatenate
from gsplat_tools.constants import SH_C0
from gsplat_tools.formats import ply

FOLDER = Path(__file__).resolve().parent.parent / "fixtures"
SEED = 20240607
SH_DEGREE = 3
SIGNIFICANT_BITS = 16

UP = np.array([0.0, -1.0, 0.0])
SUN = np.array([-0.55, -0.72, -0.42]) / np.linalg.norm([-0.55, -0.72, -0.42])  # toward the sun: left, up, behind the viewer
SUNLIGHT = np.array([1.25, 1.10, 0.85])
SKYLIGHT = np.array([0.34, 0.42, 0.56])
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))

BALL_CENTER, BALL_RADIUS = np.array([0.78, -0.36, -0.18]), 0.36
STATUE_FOOT = np.array([-0.42, 0.0, 0.30])
POND_CENTER, POND_RADII = np.array([0.10, -0.004, -0.98]), np.array([0.52, 0.30])
GARDEN_RADIUS = 1.75

# Radius of the statue over its height, from the foot of the pedestal to the crown of the head.
STATUE_PROFILE = np.array(
    [
        (0.00, 0.235), (0.05, 0.240), (0.06, 0.200), (0.30, 0.185), (0.31, 0.225), (0.36, 0.225), (0.37, 0.150),
        (0.45, 0.165), (0.58, 0.135), (0.72, 0.100), (0.84, 0.125), (0.98, 0.150), (1.05, 0.130), (1.10, 0.060),
        (1.15, 0.048), (1.19, 0.075), (1.26, 0.096), (1.33, 0.092), (1.39, 0.065), (1.425, 0.012),
    ]
)  # fmt: skip


def splats(
    means: np.ndarray,
    axes: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    rng: np.random.Generator,
    view_dependent: np.ndarray | None = None,
) -> GaussianCloud:
    """Return splats from what one sees: axes are (N, 3, 3) columns, colors (N, 3), view_dependent (N, 16, 3)."""
    count = len(means)
    sh = np.zeros((count, (SH_DEGREE + 1) ** 2, 3)) if view_dependent is None else view_dependent.copy()
    sh[:, 0] += (colors - 0.5) / SH_C0
    for band, noise in ((1, 0.020), (2, 0.012), (3, 0.007)):  # as training leaves it
        sh[:, band**2 : (band + 1) ** 2] += noise * rng.standard_normal((count, 2 * band + 1, 3))
    quats = quaternions.from_matrix(axes) * rng.uniform(0.5, 2.0, (count, 1)) * rng.choice([-1.0, 1.0], (count, 1))
    arrays = (means, np.log(scales), quats, np.log(opacities) - np.log1p(-opacities), sh[:, 0], sh[:, 1:])
    return GaussianCloud(*[round_bits(values) for values in arrays])


def round_bits(values: np.ndarray) -> np.ndarray:
    """Round to SIGNIFICANT_BITS, as float32."""
    mantissas, exponents = np.frexp(values)
    return np.ldexp(np.round(np.ldexp(mantissas, SIGNIFICANT_BITS)), exponents - SIGNIFICANT_BITS).astype(np.float32)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors to unit length."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def frames(normals: np.ndarray, rng: np.random.Generator, along: np.ndarray | None = None) -> np.ndarray:
    """Return proper rotations whose third column is the normal; the first is random, or near `along`."""
    guide = rng.standard_normal(normals.shape) if along is None else np.broadcast_to(along, normals.shape)
    first = unit(guide - (guide * normals).sum(-1, keepdims=True) * normals)
    return np.stack([first, np.cross(normals, first), normals], axis=-1)


def needle_frames(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return proper rotations whose first column is the direction."""
    return np.roll(frames(directions, rng), 1, axis=-1)


def lit(albedo: np.ndarray, normals: np.ndarray, sun_seen: np.ndarray | float = 1.0) -> np.ndarray:
    """Shade diffusely: sun where it is seen, sky from above, a little light back from the ground."""
    sun = np.clip(normals @ SUN, 0, None) * sun_seen
    sky = 0.5 + 0.5 * (normals @ UP)
    return albedo * (sun[:, None] * SUNLIGHT + sky[:, None] * SKYLIGHT + (1 - sky)[:, None] * np.array([0.10, 0.13, 0.07]))


def lobe(axes: np.ndarray, sharpness: float, colors: np.ndarray) -> np.ndarray:
    """Project color * exp(sharpness (d . axis - 1)) to spherical harmonics of the view direction d, (N, 16, 3).

    Source: Funk-Hecke theorem; the zonal coefficients are integrated by Gauss-Legendre quadrature.
    """
    nodes, weights = np.polynomial.legendre.leggauss(64)
    profile = np.exp(sharpness * (nodes - 1))
    legendre = [np.polynomial.legendre.Legendre.basis(band)(nodes) for band in range(SH_DEGREE + 1)]
    zonal = [2 * np.pi * float((weights * profile * values).sum()) for values in legendre]
    per_basis = np.repeat(zonal, [2 * band + 1 for band in range(SH_DEGREE + 1)])
    return (evaluate_basis(axes, SH_DEGREE) * per_basis)[:, :, None] * colors[:, None, :]


def gloss(normals: np.ndarray, strength: np.ndarray | float, sky: np.ndarray, sun_seen: np.ndarray | float = 1.0) -> np.ndarray:
    """Return what a polished surface adds: the sun's reflection, and sky above the reflected horizon (linear in d)."""
    mirrored_sun = SUN - 2 * (normals @ SUN)[:, None] * normals  # the view direction that is reflected toward the sun
    facing = np.clip(4 * (normals @ SUN) + 0.6, 0, 1) * sun_seen * strength
    sun = lobe(mirrored_sun, 9.0, facing[:, None] * np.array([1.5, 1.35, 1.1]))
    horizon = UP - 2 * (normals @ UP)[:, None] * normals
    mirrored = np.zeros_like(sun)
    mirrored[:, 1:4] = (
        (4 * np.pi / 3) * evaluate_basis(horizon, 1)[:, 1:, None] * sky * np.broadcast_to(strength, len(normals))[:, None, None]
    )
    return sun + mirrored


def statue_radius(heights: np.ndarray) -> np.ndarray:
    """Return the radius of the statue at heights above its foot."""
    return np.interp(heights, *STATUE_PROFILE.T)


def sun_seen_from(points: np.ndarray) -> np.ndarray:
    """Return how much of the sun is seen, 0 to 1, past the ball and the statue."""
    seen = np.ones(len(points))
    heights = np.linspace(0.05, 1.38, 24)
    centers = np.concatenate([BALL_CENTER[None], STATUE_FOOT + heights[:, None] * UP])
    radii = np.concatenate([[BALL_RADIUS], statue_radius(heights)])
    for center, radius in zip(centers, radii, strict=True):
        toward = center - points
        along = toward @ SUN
        miss = np.linalg.norm(toward - along[:, None] * SUN, axis=1)
        shade = np.clip((miss - 0.82 * radius) / (0.36 * radius), 0, 1)
        seen = np.where(along > 0, np.minimum(seen, 0.12 + 0.88 * shade), seen)
    return seen


def sunflower(count: int, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Return points spread evenly over a disc, (N, 2)."""
    index = np.arange(count) + rng.uniform(0.2, 0.8, count)
    angles = GOLDEN_ANGLE * np.arange(count)
    return radius * np.sqrt(index / count)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def is_pond(points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Whether points lie in the pond, grown by a margin."""
    return (((points[:, [0, 2]] - POND_CENTER[[0, 2]]) / (POND_RADII + margin)) ** 2).sum(1) < 1


def make_ground(rng: np.random.Generator) -> GaussianCloud:
    """A lawn with a path of stepping stones around the pond."""
    count = 1150
    flat = sunflower(count, GARDEN_RADIUS, rng)
    bumps = 0.018 * np.sin(5 * flat[:, 0]) * np.cos(4 * flat[:, 1] + 1)
    means = np.stack([flat[:, 0], bumps, flat[:, 1]], axis=1)
    normals = unit(UP + 0.10 * rng.standard_normal((count, 3)))
    patches = 0.5 + 0.5 * np.sin(3.1 * flat[:, 0] + 1.3 * np.sin(2.3 * flat[:, 1]))
    albedo = (
        np.array([0.16, 0.36, 0.09]) + patches[:, None] * np.array([0.16, 0.13, 0.02]) + 0.03 * rng.standard_normal((count, 3))
    )
    shore = is_pond(means, 0.12) & ~is_pond(means)
    albedo[shore] = np.array([0.60, 0.54, 0.42]) + 0.06 * rng.standard_normal((int(shore.sum()), 1))
    spacing = GARDEN_RADIUS * np.sqrt(np.pi / count)
    scales = spacing * np.stack(
        [rng.uniform(0.55, 0.85, count), rng.uniform(0.45, 0.65, count), rng.uniform(0.02, 0.10, count)], axis=1
    )
    colors = lit(np.clip(albedo, 0.02, 1), normals, sun_seen_from(means))
    keeps = ~is_pond(means)
    ground = splats(means, frames(normals, rng), scales, rng.uniform(0.85, 0.995, count), colors, rng)
    return concatenate([ground.take(keeps), make_stones(rng), make_pond(rng)])


def make_stones(rng: np.random.Generator) -> GaussianCloud:
    """Stepping stones on an arc from the front to the statue."""
    turns = np.linspace(-0.55, 1.75, 9)
    centers = np.stack([0.22 - 1.05 * np.cos(turns), np.full(9, -0.022), -0.30 - 0.95 * np.sin(-turns + 0.35)], axis=1)
    offsets = np.concatenate([sunflower(11, 0.105, rng) * np.array([1.25, 0.9]) for _ in centers])
    means = np.repeat(centers, 11, axis=0) + np.stack([offsets[:, 0], np.zeros(99), offsets[:, 1]], axis=1)
    normals = unit(UP + 0.06 * rng.standard_normal((99, 3)))
    albedo = np.clip(np.repeat(rng.uniform(0.48, 0.62, (9, 1)), 11, axis=0) + np.array([0.05, 0.01, -0.05]), 0, 1)
    scales = np.stack([rng.uniform(0.034, 0.045, 99), rng.uniform(0.028, 0.036, 99), rng.uniform(0.003, 0.008, 99)], axis=1)
    return splats(means, frames(normals, rng), scales, np.full(99, 0.985), lit(albedo, normals, sun_seen_from(means)), rng)


def make_pond(rng: np.random.Generator) -> GaussianCloud:
    """Still water: discs that mirror the sky and, at one angle, the sun."""
    count = 130
    flat = sunflower(count, 1.0, rng) * POND_RADII
    means = POND_CENTER + np.stack([flat[:, 0], np.zeros(count), flat[:, 1]], axis=1)
    normals = unit(UP + 0.035 * rng.standard_normal((count, 3)))
    depth = 1 - np.linalg.norm(flat / POND_RADII, axis=1)
    colors = np.array([0.16, 0.38, 0.42]) + depth[:, None] * np.array([-0.10, -0.14, 0.02])
    scales = np.stack([np.full(count, 0.044), np.full(count, 0.032), np.full(count, 0.0015)], axis=1)
    shine = gloss(normals, 0.8, np.array([0.20, 0.30, 0.42]), sun_seen_from(means))
    return splats(
        means, frames(normals, rng, np.array([1.0, 0, 0])), scales, rng.uniform(0.80, 0.97, count), colors, rng, shine
    )


def make_ball(rng: np.random.Generator) -> GaussianCloud:
    """A gazing ball of polished copper."""
    count = 620
    heights = 1 - 2 * (np.arange(count) + 0.5) / count
    turns = GOLDEN_ANGLE * np.arange(count)
    normals = np.stack([np.sqrt(1 - heights**2) * np.cos(turns), heights, np.sqrt(1 - heights**2) * np.sin(turns)], axis=1)
    spacing = BALL_RADIUS * np.sqrt(4 * np.pi / count)
    scales = spacing * np.stack(
        [rng.uniform(0.55, 0.70, count), rng.uniform(0.50, 0.62, count), rng.uniform(0.03, 0.08, count)], axis=1
    )
    colors = lit(np.array([[0.62, 0.20, 0.12]]), normals) * 0.62 + np.array([0.05, 0.02, 0.03])
    shine = gloss(normals, 1.0, np.array([0.22, 0.14, 0.13]))
    means = BALL_CENTER + BALL_RADIUS * normals
    return splats(means, frames(normals, rng), scales, rng.uniform(0.90, 0.998, count), colors, rng, shine)


def make_statue(rng: np.random.Generator) -> GaussianCloud:
    """A marble figure on a pedestal: a draped surface of revolution."""
    count = 1240
    fine = np.linspace(0, STATUE_PROFILE[-1, 0], 2000)
    steps = np.hypot(np.diff(fine), np.diff(statue_radius(fine)))
    area = np.concatenate([[0], np.cumsum(2 * np.pi * statue_radius(fine[1:]) * steps)])
    heights = np.interp((np.arange(count) + 0.5) / count * area[-1], area, fine)
    turns = GOLDEN_ANGLE * np.arange(count)

    def surface(height: np.ndarray, turn: np.ndarray) -> np.ndarray:
        is_body = np.clip((height - 0.37) / 0.05, 0, 1) * np.clip((1.05 - height) / 0.1, 0, 1)
        radius = statue_radius(height) * (1 + is_body * 0.07 * np.sin(5 * turn + 5 * height))
        sway = is_body * 0.035 * np.sin(4.5 * (height - 0.37))
        return STATUE_FOOT + np.stack([radius * np.cos(turn) + sway, -height, radius * np.sin(turn)], axis=1)

    means = surface(heights, turns)
    tangent = surface(heights, turns + 1e-4) - surface(heights, turns - 1e-4)
    rise = surface(heights + 1e-4, turns) - surface(heights - 1e-4, turns)
    normals = unit(np.cross(tangent, rise))
    outward = means - (STATUE_FOOT + heights[:, None] * UP)
    normals *= np.sign((normals * outward).sum(1, keepdims=True))
    spacing = np.sqrt(area[-1] / count)
    scales = spacing * np.stack(
        [rng.uniform(0.50, 0.75, count), rng.uniform(0.42, 0.60, count), rng.uniform(0.05, 0.15, count)], axis=1
    )
    folds = 0.94 + 0.06 * np.sin(5 * turns + 5 * heights)
    albedo = np.array([0.80, 0.77, 0.72]) * folds[:, None] + 0.02 * rng.standard_normal((count, 1))
    is_stone = heights < 0.37
    albedo[is_stone] = np.array([0.52, 0.47, 0.42]) + 0.03 * rng.standard_normal((int(is_stone.sum()), 1))
    occlusion = np.clip(0.65 + 0.5 * heights, 0, 1)
    colors = lit(albedo, normals) * occlusion[:, None]
    shine = gloss(normals, np.where(is_stone, 0.0, 0.22), np.array([0.08, 0.09, 0.11]))
    return splats(means, frames(normals, rng), scales, rng.uniform(0.75, 0.99, count), colors, rng, shine)


def make_grass(rng: np.random.Generator) -> GaussianCloud:
    """Blades: needles of aspect 4 to 100, thicker where the lawn meets its edge."""
    count = 820
    turns = rng.uniform(0, 2 * np.pi, count)
    radii = GARDEN_RADIUS * np.where(rng.random(count) < 0.6, rng.uniform(0.80, 1.0, count), np.sqrt(rng.random(count)))
    roots = np.stack([radii * np.cos(turns), np.zeros(count), radii * np.sin(turns)], axis=1)
    lengths = rng.uniform(0.025, 0.075, count) * np.where(radii > 0.78 * GARDEN_RADIUS, 1.9, 1.0)
    directions = unit(UP + 0.42 * rng.standard_normal((count, 3)))
    aspects = np.exp(rng.uniform(np.log(4), np.log(100), count))
    thickness = lengths / aspects
    scales = np.stack([lengths, thickness, np.clip(thickness * rng.uniform(0.3, 1.0, count), lengths / 100, None)], axis=1)
    tips = rng.random(count)[:, None]
    albedo = (1 - tips) * np.array([0.12, 0.34, 0.06]) + tips * np.array([0.46, 0.58, 0.16])
    means = roots + directions * lengths[:, None] * 1.6
    colors = lit(albedo, unit(UP + 0.6 * rng.standard_normal((count, 3))), sun_seen_from(means)) * 1.15
    glow = lobe(np.tile(SUN, (count, 1)), 3.0, 0.35 * albedo)  # light through the blades, seen against the sun
    keeps = ~is_pond(roots, 0.05)
    return splats(means, needle_frames(directions, rng), scales, rng.uniform(0.45, 0.98, count), colors, rng, glow).take(keeps)


def make_flowers(rng: np.random.Generator) -> GaussianCloud:
    """Blossoms of five petals around a heart, on stems."""
    count = 46
    turns = rng.uniform(0, 2 * np.pi, count)
    radii = GARDEN_RADIUS * rng.uniform(0.55, 0.98, count)
    heads = np.stack([radii * np.cos(turns), -rng.uniform(0.10, 0.26, count), radii * np.sin(turns)], axis=1)
    palette = np.array(
        [(0.95, 0.25, 0.35), (0.98, 0.72, 0.15), (0.72, 0.35, 0.90), (0.98, 0.95, 0.92), (0.98, 0.50, 0.70), (0.30, 0.45, 0.95)]
    )
    kinds = palette[rng.integers(0, len(palette), count)]
    facing = unit(UP + 0.5 * SUN + np.array([0, 0, -0.7]) + 0.35 * rng.standard_normal((count, 3)))
    sizes = rng.uniform(0.020, 0.036, count)
    bases = frames(facing, rng)
    parts = []
    for petal in range(5):
        angle = 2 * np.pi * petal / 5
        out = bases[:, :, 0] * np.cos(angle) + bases[:, :, 1] * np.sin(angle)
        tilted = unit(facing + 0.35 * out)
        outward = unit(out - (out * tilted).sum(1, keepdims=True) * tilted)
        axes = np.stack([outward, np.cross(tilted, outward), tilted], axis=-1)
        scales = sizes[:, None] * np.array([0.72, 0.44, 0.05])
        colors = lit(np.clip(kinds * rng.uniform(0.9, 1.05, (count, 1)), 0, 1), tilted) * 0.85
        parts.append(splats(heads + out * sizes[:, None], axes, scales, rng.uniform(0.85, 0.99, count), colors, rng))
    hearts = np.tile([0.98, 0.80, 0.20], (count, 1))
    parts.append(
        splats(heads + 0.006 * facing, bases, sizes[:, None] * np.array([0.36, 0.36, 0.22]), np.full(count, 0.99), hearts, rng)
    )
    stems = needle_frames(unit(np.tile(UP, (count, 1)) + 0.05 * rng.standard_normal((count, 3))), rng)
    lengths = -heads[:, 1] / 3.2
    scales = np.stack([lengths, np.full(count, 0.0035), np.full(count, 0.0030)], axis=1)
    parts.append(
        splats(heads * np.array([1, 0.5, 1]), stems, scales, np.full(count, 0.9), np.tile([0.20, 0.42, 0.12], (count, 1)), rng)
    )
    return concatenate(parts)


def make_air(rng: np.random.Generator) -> GaussianCloud:
    """What training leaves about: dust down to a tenth of a millimeter, faint floaters up to a meter, a few strays."""
    dust = 110
    turns, radii = rng.uniform(0, 2 * np.pi, dust), GARDEN_RADIUS * np.sqrt(rng.random(dust))
    means = np.stack([radii * np.cos(turns), -rng.uniform(0.02, 1.3, dust), radii * np.sin(turns)], axis=1)
    sizes = np.exp(rng.uniform(np.log(1e-4), np.log(4e-3), dust))[:, None] * rng.uniform(0.7, 1.0, (dust, 3))
    sizes = np.clip(sizes, 1e-4, None)
    gold = np.array([1.0, 0.9, 0.6]) * rng.uniform(0.6, 1.2, (dust, 1))
    parts = [splats(means, frames(unit(rng.standard_normal((dust, 3))), rng), sizes, rng.uniform(0.3, 0.9999, dust), gold, rng)]
    floaters = 26
    means = np.stack([rng.uniform(-2, 2, floaters), -rng.uniform(0.1, 1.6, floaters), rng.uniform(0.4, 2.2, floaters)], axis=1)
    sizes = np.exp(rng.uniform(np.log(0.08), np.log(1.0), floaters))[:, None] * rng.uniform(0.35, 1.0, (floaters, 3))
    haze = np.array([0.55, 0.62, 0.78]) + 0.12 * rng.standard_normal((floaters, 3))
    opacities = np.exp(rng.uniform(np.log(0.006), np.log(0.09), floaters))
    parts.append(splats(means, frames(unit(rng.standard_normal((floaters, 3))), rng), sizes, opacities, haze, rng))
    strays = 6
    means = 6.0 * unit(rng.standard_normal((strays, 3))) * rng.uniform(0.6, 1.0, (strays, 1))
    sizes = rng.uniform(0.05, 0.2, (strays, 3))
    grays = np.tile(rng.uniform(0.2, 0.5, (strays, 1)), 3)
    parts.append(
        splats(means, frames(unit(rng.standard_normal((strays, 3))), rng), sizes, rng.uniform(0.004, 0.03, strays), grays, rng)
    )
    return concatenate(parts)


def make_garden() -> GaussianCloud:
    """Return the scene; its splats are in no order, as after training."""
    makers = (make_ground, make_ball, make_statue, make_grass, make_flowers, make_air)
    # A generator each, so that changing one part leaves the others as they are.
    seeds = np.random.SeedSequence(SEED).spawn(len(makers) + 1)
    cloud = concatenate([make(np.random.default_rng(seed)) for make, seed in zip(makers, seeds[:-1], strict=True)])
    order = np.random.default_rng(seeds[-1]).permutation(len(cloud))
    return cloud.take(order).replace(coordinate_system="RDF")


def main() -> None:
    """Write the fixtures."""
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / "garden.ply"
    cloud = make_garden()
    with path.open("wb") as stream:
        ply.write(cloud, stream)
    print(f"{path.relative_to(FOLDER.parent)}: {len(cloud)} splats, {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
