"""Checks before and after a self-calibration: what is refused, weak or contradicts rig.toml.

The last ones test that each view is one placement of the target, which all cameras saw at the same
time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.special import gammaincinv

from telerig.arrays import Array, Bools
from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver.covariance import JointCovariance
from telerig.estimator.calibration.solver.problem import Problem, prior_sigma
from telerig.estimator.calibration.start.known_target import (
    ImageMap,
    image_maps,
    offset_freedom,
    origin_camera,
    overlap_tree,
)
from telerig.estimator.calibration.thresholds import (
    CLEAR_MISFIT,
    COPY_CHANCE,
    FAR_BETTER,
    FAR_BETTER_OF_TWO,
    LEAST_DOTS,
    LEAST_VIEWS,
    PARALLEL_DEG,
    RECOMMENDED_VIEWS,
    STRONG_PERSPECTIVE,
    UNPAIRED,
)
from telerig.estimator.dots.grid.lattice import epipolar_products
from telerig.factors.calibration import State
from telerig.io.results.findings import Code, Finding
from telerig.rig.lens_parameters import INDEX
from telerig.rig.target import check_handedness


@dataclass(frozen=True)
class PreCheck:
    """The result of the checks before a calibration.

    tilts_deg : by (index of the view, index of the camera) the angle between the target's normal
        and the optical axis.
    """

    tilts_deg: dict[tuple[int, int], float]
    findings: tuple[Finding, ...]


def pre_check(problem: Problem, dots_mm: Array, *, unknown_dots: bool) -> PreCheck:
    """Check before a calibration whether the views can determine it.

    dots_mm : (N, 3) positions of the target's N dots in its frame. unknown_dots : whether these are
    only estimates; then more views are needed.
    Returns the target's tilt against each camera in degrees, by (view, camera), and findings on
    what will be poorly determined. Raises CalibrationError for too
    few views, too few dots or parallel views, and DetectionError for mirrored images of a target
    that is visible from one side only.
    """
    maps = image_maps(problem, dots_mm)
    stereo = len(problem.cameras) > 1
    views, cameras = range(len(problem.views)), range(len(problem.cameras))
    shared = [v for v in views if sum((v, c) in maps for c in cameras) > 1]
    usable = shared if stereo else sorted({v for v, _ in maps})
    _refuse_too_few(problem, usable, stereo=stereo, unknown_dots=unknown_dots)
    if stereo:
        _refuse_thin_links(problem, set(maps))
    findings = _mirrored(problem, maps)
    tilts = {k: _tilt_deg(m.jacobian) for k, m in maps.items()}
    _refuse_parallel(problem, maps, usable)
    if len(usable) < Code.FEW_VIEWS.limit:
        findings.append(Code.FEW_VIEWS.found(count=len(usable)))
    for c, camera in enumerate(problem.cameras):
        largest = max((t for (_, k), t in tilts.items() if k == c), default=np.inf)
        if largest < Code.SMALL_TILTS.limit:
            findings.append(Code.SMALL_TILTS.found(cameras=camera.name, tilt_deg=largest))
        cells = _cells_covered(problem, c)
        if cells < Code.COVERAGE.limit:
            findings.append(Code.COVERAGE.found(cameras=camera.name, cells=cells))
        alone = [n for v, n in enumerate(problem.views) if {k for w, k in maps if w == v} == {c}]
        if stereo and alone:
            findings.append(Code.ONE_CAMERA.found(cameras=camera.name, views=alone))
    unused = [n for v, n in enumerate(problem.views) if v not in {w for w, _ in maps}]
    if unused:
        findings.append(Code.UNUSED_VIEWS.found(views=unused))
    return PreCheck(tilts, tuple(findings))


def _refuse_too_few(
    problem: Problem, usable: list[int], *, stereo: bool, unknown_dots: bool
) -> None:
    if unknown_dots:
        needed = LEAST_VIEWS
        undetermined = "the shape of the target (3 affine numbers) and with it the scale"
    elif stereo:
        needed, undetermined = 2, "the rotation between the cameras: two of them fit equally well"
    else:
        needed, undetermined = 1, "everything"
    if len(usable) >= needed:
        return
    kind = "unknown" if unknown_dots else "known"
    both = f" in {_those(problem)}" if stereo else ""
    counts = {
        (problem.views[v], problem.cameras[c].name): int(np.sum(rows))
        for v in range(len(problem.views))
        for c in range(len(problem.cameras))
        if (rows := (problem.view == v) & (problem.camera == c)).sum() < LEAST_DOTS
    }
    poor = "; ".join(f"view {v}, camera {c}: {n} dots" for (v, c), n in list(counts.items())[:6])
    raise CalibrationError(
        f"{len(usable)} view(s) with {LEAST_DOTS} or more dots{both}; a target of {kind} dots "
        f"needs at least {needed}. Undetermined with fewer: {undetermined}."
        + (f" Too few dots in: {poor}." if poor else ""),
        todo=f"take at least {RECOMMENDED_VIEWS} views at different tilts, seen by "
        + _those(problem),
    )


def _those(problem: Problem) -> str:
    """Return in words which cameras must see a view."""
    known = {1: "the camera", 2: "both cameras"}
    return known.get(len(problem.cameras), "two cameras or more")


def _refuse_thin_links(problem: Problem, images: set[tuple[int, int]]) -> None:
    """Raise CalibrationError if a camera is linked to the first one by fewer than two views."""
    for a, b in overlap_tree(problem, images):
        count = sum({(v, a), (v, b)} <= images for v in range(len(problem.views)))
        if count < 2:
            names = [problem.cameras[c].name for c in (a, b)]
            raise CalibrationError(
                f"cameras {names[0]!r} and {names[1]!r} have {count} view in common, which does "
                "not determine the rotation between them: two different ones fit equally well",
                todo="add views at other tilts that both of them see",
            )


def loose_offsets(problem: Problem, state: State) -> list[Finding]:
    """Return a finding for each camera whose offset relative to the others no view determines.

    A view that two telecentric cameras see determines the offset of the two cameras only along the
    common perpendicular of their axes; a view that three cameras see determines the rest. To find
    the offsets that are not determined, the positions of the target are eliminated from the linear
    equations of all offsets; see docs/theory.md. With fewer than three cameras, or with clear
    perspective in all lenses, there is none.
    """
    count = len(problem.cameras)
    kappa_rho = state.intrinsics[:, INDEX["kappa_per_mm"]] * np.array(problem.rho_mm)
    if count < 3 or np.all(np.abs(kappa_rho) > STRONG_PERSPECTIVE):
        return []
    turns = np.swapaxes(state.rig_from_camera[:, :3, :3], -1, -2)
    free = offset_freedom(turns)
    normal = np.zeros((free.shape[-1],) * 2)
    for v in range(len(problem.views)):
        mine = (problem.view == v) & problem.kept
        seen = np.flatnonzero(np.bincount(problem.camera[mine], minlength=count) >= LEAST_DOTS)
        if len(seen) > 1:
            place, rows = np.concatenate(turns[seen, :2]), np.concatenate(free[seen])
            left = rows - place @ np.linalg.lstsq(place, rows, rcond=1e-9)[0]
            normal += left.T @ left
    values, vectors = np.linalg.eigh(normal)
    loose = vectors[:, values < Code.OFFSET.limit**2 * values[-1]]
    size = np.linalg.norm(np.einsum("cij,jk->cik", free, loose), axis=1)
    cameras = sorted({int(c) for c in size.argmax(0)}) if size.size else []
    return [Code.OFFSET.found(cameras=problem.cameras[c].name) for c in cameras]


def about_distance(problem: Problem, *, held: bool) -> list[Finding]:
    """Return the finding that a measured distance has no effect, or contradicts the nominal places.

    held : whether the dots are held at their nominal places.
    """
    if problem.scale is None:
        return []
    (a, b), stated, sd = problem.scale
    nominal = float(np.linalg.norm(problem.nominal_mm[a] - problem.nominal_mm[b]))
    if held:
        return [Code.DISTANCE_UNUSED.found(nominal_mm=nominal, stated_mm=stated)]
    expected = np.hypot(sd, np.sqrt(2) * problem.target.print_sigma_mm)
    deviations = abs(stated - nominal) / float(expected)
    if deviations < Code.DISTANCE_FAR.limit:
        return []
    return [Code.DISTANCE_FAR.found(stated_mm=stated, nominal_mm=nominal, deviations=deviations)]


def scales_beside_nominal(problem: Problem, state: State) -> list[Finding]:
    """Return findings of scales that contradict rig.toml: exchanged cameras, or a wrong unit.

    The estimated scale of each of two exchanged cameras is near the nominal scale of the other; of
    nominal scales that are alike nothing can be concluded. Without such cameras, those are named
    whose scale is so far from the nominal one that a unit may be wrong.
    """
    estimated = np.log(state.intrinsics[:, INDEX["scale_px_per_mm"]])
    nominal = np.log([camera["scale_px_per_mm"] for camera in problem.cameras])
    findings = []
    for a, b in combinations(range(len(problem.cameras)), 2):
        own = abs(estimated[a] - nominal[a]) + abs(estimated[b] - nominal[b])
        crossed = abs(estimated[a] - nominal[b]) + abs(estimated[b] - nominal[a])
        if own > Code.EXCHANGED.limit and crossed < own / 4:
            scales = [np.exp(logarithm[c]) for logarithm in (estimated, nominal) for c in (a, b)]
            numbers = dict(zip(("first", "second", "first_stated", "second_stated"), scales))
            names = [problem.cameras[c].name for c in (a, b)]
            findings.append(Code.EXCHANGED.found(cameras=names, **numbers))
    if findings:
        return findings
    return [
        Code.SCALE_FAR.found(cameras=camera.name, found=np.exp(scale), stated=np.exp(stated))
        for camera, scale, stated in zip(problem.cameras, estimated, nominal)
        if abs(scale - stated) > np.log(Code.SCALE_FAR.limit)
    ]


def _mirrored(problem: Problem, maps: dict[tuple[int, int], ImageMap]) -> list[Finding]:
    """Return a finding if all images are mirrored; raise DetectionError if only some of them are.

    Images that show the target nearly edge on, or whose dots do not fit it, are left out.
    """
    hands = {}
    for (v, c), m in maps.items():
        singular = np.linalg.svd(m.jacobian, compute_uv=False)
        clear = singular[1] > 0.02 * singular[0] and m.misfit < CLEAR_MISFIT
        sign = int(np.sign(np.linalg.det(m.jacobian))) if clear else 0
        hands[problem.views[v], problem.cameras[c].name] = sign
    check_handedness(hands, problem.target.two_sided)
    if problem.target.two_sided or not hands or max(hands.values()) > 0:
        return []
    return [Code.MIRRORED.found()]


def _tilt_deg(jacobian: Array) -> float:
    singular = np.linalg.svd(jacobian, compute_uv=False)
    return float(np.degrees(np.arccos(np.clip(singular[1] / singular[0], -1, 1))))


def _refuse_parallel(
    problem: Problem, maps: dict[tuple[int, int], ImageMap], usable: list[int]
) -> None:
    """Raise CalibrationError if the target has the same tilt in all views (docs/theory.md).

    Each camera then sees it foreshortened by one factor along one direction of the target.
    """
    spread = 0.0
    for c in range(len(problem.cameras)):
        mine = [m.jacobian for (v, k), m in maps.items() if k == c and v in usable]
        if len(mine) > 1:
            _, singular, axes = np.linalg.svd(np.array(mine))
            sine = np.sqrt(np.clip(1 - (singular[:, 1] / singular[:, 0]) ** 2, 0, 1))
            along = axes[:, 1]
            vectors = sine[:, None, None] * along[:, :, None] * along[:, None, :]
            spread = max(spread, float(np.degrees(np.ptp(vectors, 0).max())))
    if len(usable) > 1 and spread < PARALLEL_DEG:
        raise CalibrationError(
            f"all views are parallel: the target's tilt differs by {spread:.1f} degrees at most. "
            "Then a larger depth with a smaller tilt gives nearly the same images (bas-relief "
            "ambiguity), so the scale along the depth is not determined",
            todo="tilt the target differently in every view, by 20-60 degrees about several axes",
        )


def _cells_covered(problem: Problem, c: int) -> int:
    """Return in how many of the 4 x 4 parts of a camera's image dots were found."""
    uv = problem.uv_px[problem.camera == c]
    cells = np.floor(uv / np.array(problem.cameras[c].image_size_px) * 4).astype(int)
    return len(np.unique(np.clip(cells, 0, 3), axis=0))


def axes_angle_deg(state: State) -> float:
    """Return the angle of the axes that fix the origin (`origin_camera`), 0 to 90 degrees."""
    axes = state.rig_from_camera[:, :3, 2]
    other = axes[origin_camera(np.swapaxes(state.rig_from_camera[:, :3, :3], -1, -2))]
    return float(np.degrees(np.arccos(min(abs(axes[0] @ other), 1.0))))


def parallel_axes(state: State) -> list[Finding]:
    """Return a finding if the optical axes are nearly parallel: `axes_angle_deg`."""
    if len(state.rig_from_camera) < 2 or axes_angle_deg(state) > Code.NEAR_PARALLEL.limit:
        return []
    return [Code.NEAR_PARALLEL.found(angle_deg=axes_angle_deg(state))]


def weak_parameters(problem: Problem, joint: JointCovariance) -> list[Finding]:
    """Return findings on parameters of the rig that the views determine poorly.

    Their standard deviation is a large share of the prior's, or they are strongly correlated.
    """
    names, covariance = joint.rig_block()
    sd = np.sqrt(np.diag(covariance))
    found = []
    for camera, free in zip(problem.cameras, problem.free):
        prior = prior_sigma(camera)
        for name in (f"{camera.name}.{parameter}" for parameter in free):
            share = sd[names.index(name)] / prior[INDEX[name.rpartition(".")[2]]]
            if share > Code.WEAK.limit:
                found.append(Code.WEAK.found(names=name, share=share))
    return found + linked_parameters(names, covariance)


def linked_parameters(names: tuple[str, ...], covariance: Array) -> list[Finding]:
    """Return a finding for each group of parameters that strong correlations link."""
    sd = np.maximum(np.sqrt(np.diag(covariance)), 1e-300)
    correlation = covariance / np.outer(sd, sd) - np.eye(len(sd))
    count, group = connected_components(np.abs(correlation) > Code.LINKED.limit, directed=False)
    found = []
    for members in (np.flatnonzero(group == k) for k in range(count)):
        if len(members) > 1:
            among = correlation[np.ix_(members, members)].ravel()
            largest = among[np.abs(among).argmax()]
            found.append(Code.LINKED.found(names=[names[i] for i in members], correlation=largest))
    return found


WINDOW = 3
"""Number of consecutive views that show together whether two cameras' images belong together."""


def refuse_copies(problem: Problem) -> None:
    """Raise CalibrationError if two images have the same noise, so that one is a copy.

    The sum of squared differences, in units of this noise, is chi-square distributed for
    independent images, and about zero for a copy.
    """
    count = len(problem.dot_ids)
    images, rows = np.unique(
        np.stack([problem.camera, problem.view], axis=1), axis=0, return_inverse=True
    )
    uv = np.full((len(images), count, 2), np.nan)
    variance = np.full((len(images), count), np.nan)
    uv[rows, problem.dot] = problem.uv_px
    variance[rows, problem.dot] = np.trace(problem.covariance_px2, axis1=1, axis2=2) / 2
    for i in range(len(images) - 1):
        squares = ((uv[i + 1 :] - uv[i]) ** 2).sum(-1) / (variance[i + 1 :] + variance[i])
        common = np.isfinite(squares).sum(-1)
        total = np.nansum(squares, axis=-1)
        copies = (common >= LEAST_DOTS) & (total < 2 * gammaincinv(common, COPY_CHANCE))
        if copies.any():
            (a, v), (b, w) = images[i], images[i + 1 + int(np.argmax(copies))]
            names = [
                f"camera {problem.cameras[c].name!r} view {problem.views[k]!r}"
                for c, k in ((a, v), (b, w))
            ]
            raise CalibrationError(
                f"{names[0]} and {names[1]} are copies of one image: even their noise is the same. "
                "Counted twice, they would make the calibration seem better than it is",
                todo="remove the copy; if the two should differ, look for the mistake in copying; "
                "if both are of a target at rest, the dots' standard deviations are far too large",
            )


def refuse_wrong_pairs(problem: Problem) -> None:
    """Raise CalibrationError if a camera's images fit the views before or after far better.

    A camera may have missed a trigger, or its first image was lost. Among more than two cameras the
    wrong one is in more pairs that do not fit, and in fewer that fit, than the others.
    """
    judged = {
        pair: found
        for pair in combinations(range(len(problem.cameras)), 2)
        if (found := _better_pairing(problem, pair)) is not None
    }
    wrong = {pair: found for pair, found in judged.items() if found[1]}
    if not wrong:
        return
    against = np.zeros(len(problem.cameras))
    for pair in judged:
        against[list(pair)] += 1 if pair in wrong else -1
    # between two cameras nothing decides, and the second one is named
    own = max(np.ravel(list(wrong)).tolist(), key=lambda camera: (against[camera], camera))
    pair, (first, offset) = next(item for item in wrong.items() if own in item[0])
    view, image = problem.views[first], problem.views[first + offset]
    if own == pair[0]:
        view, image, offset = image, view, -offset
    camera, side = problem.cameras[own].name, "later" if offset > 0 else "earlier"
    raise CalibrationError(
        f"from view {problem.views[first]!r} on, the images of camera {camera!r} do not belong to "
        f"the views whose names they have: those {abs(offset)} {side} fit (image {image!r} of "
        f"camera {camera!r} shows view {view!r}), so an image of one camera was lost or added",
        todo="give images that were taken at the same time the same file name",
    )


def _better_pairing(
    problem: Problem, pair: tuple[int, int], farthest: int = 2
) -> tuple[int, int] | None:
    """Return the first view from which images of the second camera fit better that are some views
    later, and how many; 0 if those of the same view fit, and None if the views do not show it.

    farthest : largest offset that is tried.
    """
    own, _ = epipolar_misfits(problem, pair, 0)
    suspect = np.isfinite(own) & (own > UNPAIRED)
    if not suspect.any():
        return (0, 0) if np.isfinite(own).any() else None
    offsets = [s * n for n in range(1, farthest + 1) for s in (1, -1)]
    shifted, views = np.swapaxes([epipolar_misfits(problem, pair, s) for s in offsets], 0, 1)
    least = np.where(suspect, own, 0.0) * np.where(views < WINDOW, FAR_BETTER_OF_TWO, FAR_BETTER)
    far = (shifted < least).any(0)
    if not far.any():
        return 0, 0
    best = np.where(shifted < least, shifted, np.inf).argmin(0)
    chosen = int(np.bincount(best[far]).argmax())
    return int(np.flatnonzero(far & (best == chosen))[0]), offsets[chosen]


def epipolar_misfits(problem: Problem, pair: tuple[int, int], offset: int) -> tuple[Array, Array]:
    """Return how far the dots of every `WINDOW` consecutive views are from one epipolar geometry.

    It is that of dots which both cameras saw at the same time (`epipolar_products`).

    pair : indices of the cameras. offset : by how many views the second one's images are later.
    Returns the mean squares (W,) of x'^T F x, of all dots but the worst tenth, with the F of unit
    norm that makes them least, in units of half the image; infinite where fewer than two views show
    enough dots to both cameras, or all together less than twice as many as F has elements. And the
    numbers (W,) of such views.
    """
    count = len(problem.views)
    pixels = np.full((2, count, len(problem.dot_ids), 2), np.nan)
    for own, c, late in zip(pixels, pair, (0, offset)):
        view, half = problem.view - late, np.array(problem.cameras[c].image_size_px) / 2
        mine = (problem.camera == c) & (view >= 0) & (view < count)
        own[view[mine], problem.dot[mine]] = problem.uv_px[mine] / half - 1
    products = epipolar_products(*pixels)
    both = np.asarray(np.isfinite(products[..., 0]))
    both = both & (both.sum(1) >= LEAST_DOTS)[:, None]
    first = np.arange(max(count - WINDOW + 1, 0))
    windows = first[:, None] + np.arange(WINDOW)
    views, each = both.any(1)[windows].sum(1), WINDOW * both.shape[1]
    seen = both[windows].reshape(-1, each)
    shown = (views > 1) & (seen.sum(1) >= 2 * products.shape[-1])
    rows = np.nan_to_num(products)[windows[shown]].reshape(-1, each, products.shape[-1])
    out = np.full(len(first), np.inf)
    out[shown] = _trimmed_misfits(rows, seen[shown])
    return out, views


def _trimmed_misfits(rows: Array, seen: Bools, rounds: int = 4) -> Array:
    """Return the least mean squares (W,) of rows (W, n, m) times a unit vector (m,).

    They are of the 90 % of the rows seen (W, n) that fit best, so that a few dots which are not
    where they should be do not hide the others: found in turns (Rousseeuw and Van Driessen,
    Technometrics 41:212, 1999).
    """
    kept, count = seen, np.ceil(0.9 * seen.sum(1)).astype(int)
    for turn in range(rounds + 1):
        chosen = rows * kept[..., None]
        values, vectors = np.linalg.eigh(chosen.mT @ chosen)
        if turn < rounds:
            squares = np.where(seen, (rows @ vectors[..., :1])[..., 0] ** 2, np.inf)
            limit = np.take_along_axis(np.sort(squares, 1), count[:, None] - 1, 1)
            kept = squares <= limit
    return np.asarray(np.maximum(values[:, 0], 0) / np.maximum(kept.sum(1), 1))
