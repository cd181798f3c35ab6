"""Checks before and after a self-calibration: refuse, warn, and say what is poorly determined.

The last ones test that each view is one placement of the target, which all cameras saw at the same
time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.special import gammaincinv

from telerig.arrays import Array
from telerig.errors import CalibrationError, TelerigError
from telerig.estimator.calibration.solver.covariance import JointCovariance
from telerig.estimator.calibration.solver.problem import Problem, prior_sigma
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.start.known_target import (
    ImageMap,
    image_maps,
    offset_freedom,
    origin_camera,
    overlap_tree,
    stereo_states,
)
from telerig.estimator.dots.grid.numbering import check_handedness
from telerig.factors.calibration import State
from telerig.rig.lens_parameters import INDEX

RECOMMENDED_VIEWS = 6
MINIMUM_DOTS = 4
PARALLEL_DEG = 3.0
SMALL_TILT_DEG = 10.0
TOLD_APART = 0.98
"""Correlation beyond which two parameters can hardly be told apart."""
NEAR_PARALLEL_DEG = 10.0
"""Below this angle, where two optical axes come closest is too uncertain to be the origin of lenses
with perspective: the solver would need hundreds of iterations."""
PERSPECTIVE = 0.01
"""If kappa * rho (no unit) exceeds this, the image shows the depth of a view. Rho is half
the diagonal of the field of view, in mm."""
LOOSE = 0.03
"""An offset is undetermined if the views determine it less well than the best one by this factor
or more."""
OTHER_SCALE = 0.05
"""If the nominal scales of two cameras differ by less than this share, the scales do not show
whether the cameras were exchanged."""
CLEAR_MISFIT = 0.1
"""Largest accepted distance of an image's dots from the map of the target's plane, as a share of
the dots' spread."""


@dataclass(frozen=True)
class Note:
    """A sentence for the user.

    code : short name of its subject.
    affects_verdict : whether the verdict is not GOOD because of it.
    """

    code: str
    words: str
    affects_verdict: bool = False


@dataclass(frozen=True)
class PreCheck:
    """The result of the checks before a calibration.

    tilts_deg : by (index of the view, index of the camera) the angle between the target's normal
        and the optical axis.
    notes : sentences for the user.
    """

    tilts_deg: dict[tuple[int, int], float]
    notes: tuple[Note, ...]


def pre_check(problem: Problem, dots_mm: Array, *, unknown_dots: bool) -> PreCheck:
    """Check before a calibration whether the views can determine it.

    dots_mm : (N, 3) positions of the target's N dots in its frame. unknown_dots : whether these are
    only estimates; then more views are needed.
    Returns the target's tilt against each camera in degrees, by (view, camera), and notes about
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
    mirrored = _mirrored_note(problem, maps)
    tilts = {k: _tilt_deg(m.jacobian) for k, m in maps.items()}
    _refuse_parallel(problem, maps, usable)
    notes = mirrored
    if len(usable) < RECOMMENDED_VIEWS:
        words = (
            f"only {len(usable)} views can be used in "
            f"{_those(problem)}: {RECOMMENDED_VIEWS} or more are "
            "recommended. With fewer, above all the lens distortion and the dots' positions on "
            "the target become uncertain (see their standard deviations). Add views"
        )
        notes.append(Note("few views", words, affects_verdict=True))
    for c, camera in enumerate(problem.cameras):
        mine = np.array([t for (_, k), t in tilts.items() if k == c])
        if len(mine) and mine.max() < SMALL_TILT_DEG:
            words = (
                f"camera {camera.name!r}: no view is tilted by more than {mine.max():.0f} degrees, "
                "so its scale along the depth is poorly determined; add views tilted by 20-60 "
                "degrees"
            )
            notes.append(Note("small tilts", words, affects_verdict=True))
        notes += _coverage_note(problem, c)
    for v, name in enumerate(problem.views):
        seen = [c for c in range(len(problem.cameras)) if (v, c) in maps]
        if stereo and len(seen) == 1:
            camera_name = problem.cameras[seen[0]].name
            words = (
                f"view {name!r} can be used in camera {camera_name!r} only, so it does not "
                "connect the cameras"
            )
            notes.append(Note("one camera", words, affects_verdict=True))
        if not seen:
            words = f"view {name!r} has fewer than {MINIMUM_DOTS} dots in every camera"
            notes.append(Note("no camera", words))
    return PreCheck(tilts, tuple(notes))


def _refuse_too_few(
    problem: Problem, usable: list[int], *, stereo: bool, unknown_dots: bool
) -> None:
    if unknown_dots:
        needed, undetermined = 4, "the shape of the target (3 affine numbers) and with it the scale"
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
        if (rows := (problem.view == v) & (problem.camera == c)).sum() < MINIMUM_DOTS
    }
    poor = "; ".join(f"view {v}, camera {c}: {n} dots" for (v, c), n in list(counts.items())[:6])
    raise CalibrationError(
        f"{len(usable)} view(s) with {MINIMUM_DOTS} or more dots{both}; a target of {kind} dots "
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


def position_notes(problem: Problem, state: State) -> tuple[Note, ...]:
    """Return a note for each camera whose offset relative to the others no view determines.

    A view that two telecentric cameras see determines the offset of the two cameras only along the
    common perpendicular of their axes; a view that three cameras see determines the rest. To find
    the offsets that are not determined, the positions of the target are eliminated from the linear
    equations of all offsets; see docs/theory.md. With fewer than three cameras, or with clear
    perspective in all lenses, there is no note.
    """
    count = len(problem.cameras)
    kappa_rho = state.intrinsics[:, INDEX["kappa_per_mm"]] * np.array(problem.rho_mm)
    if count < 3 or np.all(np.abs(kappa_rho) > PERSPECTIVE):
        return ()
    turns = np.swapaxes(state.rig_from_camera[:, :3, :3], -1, -2)
    free = offset_freedom(turns)
    normal = np.zeros((free.shape[-1],) * 2)
    for v in range(len(problem.views)):
        mine = (problem.view == v) & problem.kept
        seen = np.flatnonzero(np.bincount(problem.camera[mine], minlength=count) >= MINIMUM_DOTS)
        if len(seen) > 1:
            place, rows = np.concatenate(turns[seen, :2]), np.concatenate(free[seen])
            left = rows - place @ np.linalg.lstsq(place, rows, rcond=1e-9)[0]
            normal += left.T @ left
    values, vectors = np.linalg.eigh(normal)
    loose = vectors[:, values < LOOSE**2 * values[-1]]
    size = np.linalg.norm(np.einsum("cij,jk->cik", free, loose), axis=1)
    cameras = sorted({int(c) for c in size.argmax(0)}) if size.size else []
    return tuple(
        Note(
            "offset",
            f"camera {problem.cameras[c].name!r}: no view is seen by this and two other cameras "
            "at once, so its offset across the common perpendiculars of the optical axes is not "
            "determined. Points that it sees together with two others are wrong by this offset. "
            "Add a view that three cameras see at once",
            affects_verdict=True,
        )
        for c in cameras
    )


def exchanged_notes(problem: Problem, state: State) -> tuple[Note, ...]:
    """Return a note for each two cameras whose folders of images were probably exchanged.

    The estimated scale of each is near the nominal scale of the other. If the nominal scales differ
    by less than `OTHER_SCALE`, nothing can be concluded, and there is no note.
    """
    estimated = np.log(state.intrinsics[:, INDEX["scale_px_per_mm"]])
    nominal = np.log([camera["scale_px_per_mm"] for camera in problem.cameras])
    notes = []
    for a, b in combinations(range(len(problem.cameras)), 2):
        own = abs(estimated[a] - nominal[a]) + abs(estimated[b] - nominal[b])
        crossed = abs(estimated[a] - nominal[b]) + abs(estimated[b] - nominal[a])
        if own > OTHER_SCALE and crossed < own / 4:
            first, second = (problem.cameras[c] for c in (a, b))
            scales = [np.exp(logarithm[c]) for logarithm in (estimated, nominal) for c in (a, b)]
            words = (
                f"cameras {first.name!r} and {second.name!r} seem to be exchanged: their scales "
                f"are {scales[0]:.3f} and {scales[1]:.3f} px/mm, rig.toml says {scales[2]:g} and "
                f"{scales[3]:g}. Check which folder holds the images of which camera: exchanged "
                "cameras mirror every depth"
            )
            notes.append(Note("exchanged cameras", words, affects_verdict=True))
    return tuple(notes)


def _mirrored_note(problem: Problem, maps: dict[tuple[int, int], ImageMap]) -> list[Note]:
    """Return a note if all images are mirrored; raise DetectionError if only some of them are.

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
    words = (
        "every image shows the target as a mirror image of rig.toml: this is right if its rows "
        "are numbered upwards; but if the cameras' images are flipped, the handedness of every "
        "helix is wrong"
    )
    return [Note("mirrored images", words)]


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


def _coverage_note(problem: Problem, c: int) -> list[Note]:
    camera = problem.cameras[c]
    mine = problem.camera == c
    if not np.any(mine):
        words = f"camera {camera.name!r} has no dots at all; check its images and [target]"
        return [Note("no dots", words)]
    cells = np.floor(problem.uv_px[mine] / np.array(camera.image_size_px) * 4).astype(int)
    filled = len({tuple(x) for x in np.clip(cells, 0, 3)})
    if filled >= 8:
        return []
    words = (
        f"camera {camera.name!r}: dots cover {filled} of 16 parts of the image; elsewhere the "
        "distortion is extrapolated. Hold the target nearer to the edges in some views"
    )
    return [Note("coverage", words)]


def axes_angle_deg(state: State) -> float:
    """Return the angle of the axes that fix the origin (`origin_camera`), 0 to 90 degrees."""
    axes = state.rig_from_camera[:, :3, 2]
    other = axes[origin_camera(np.swapaxes(state.rig_from_camera[:, :3, :3], -1, -2))]
    return float(np.degrees(np.arccos(min(abs(axes[0] @ other), 1.0))))


def parallel_notes(state: State) -> list[Note]:
    """Return a note if the optical axes are nearly parallel: `axes_angle_deg`."""
    if len(state.rig_from_camera) < 2 or axes_angle_deg(state) > NEAR_PARALLEL_DEG:
        return []
    words = (
        f"the optical axes are nearly parallel ({axes_angle_deg(state):.1f} degrees): depth is the "
        "least precise coordinate of points in space, and two telecentric cameras would not see "
        "it; 60-90 degrees between the cameras are best"
    )
    return [Note("near-parallel axes", words)]


def weak_parameters(problem: Problem, joint: JointCovariance) -> list[str]:
    """Return sentences about parameters of the rig that the views determine poorly.

    Their standard deviation exceeds half of the prior's, or a correlation exceeds `TOLD_APART`.
    """
    names, covariance = joint.rig_block()
    sd = np.sqrt(np.diag(covariance))
    out = []
    for camera, free in zip(problem.cameras, problem.free):
        prior = prior_sigma(camera)
        for name in free:
            i = names.index(f"{camera.name}.{name}")
            share = sd[i] / prior[INDEX[name]]
            if share > 0.5:
                out.append(
                    f"{_parameter_words(name)} of camera {camera.name!r} is hardly determined by "
                    f"these views: its standard deviation is {share:.0%} of that before the fit"
                )
    return out + _correlated(names, covariance)


def _correlated(names: tuple[str, ...], covariance: Array) -> list[str]:
    """Return a sentence for each group of parameters that are linked by such correlations."""
    sd = np.maximum(np.sqrt(np.diag(covariance)), 1e-300)
    correlation = covariance / np.outer(sd, sd)
    linked = np.abs(correlation) > TOLD_APART
    count, group = connected_components(linked, directed=False)
    out = []
    for k in range(count):
        members = np.flatnonzero(group == k).tolist()
        words = [_full_words(names[i]) for i in members]
        if len(members) == 2:
            size = correlation[members[0], members[1]]
            together = "both" if size > 0 else "one and a fall of the other"
            out.append(
                f"{words[0]} and {words[1]} can hardly be told apart (correlation {size:+.3f}): "
                f"a rise of {together} leaves the images almost the same"
            )
        elif len(members) > 2:
            largest = np.max(np.abs(correlation[np.ix_(members, members)] - np.eye(len(members))))
            out.append(
                f"{', '.join(words[:-1])} and {words[-1]} can hardly be told apart (correlations "
                f"up to {largest:.3f}): changed together, they leave the images almost the same"
            )
    return out


def _full_words(name: str) -> str:
    camera, _, parameter = name.partition(".")
    return f"{_parameter_words(parameter)} of camera {camera!r}"


_PARAMETER_WORDS = {
    "scale_px_per_mm": "the scale", "aspect": "the aspect ratio", "skew": "the skew",
    "centre_u_px": "the image centre (u)", "centre_v_px": "the image centre (v)",
    "kappa_per_mm": "the residual perspective kappa", "tilt_x": "the sensor tilt (x)",
    "tilt_y": "the sensor tilt (y)", "image_convergence_per_mm": "the image-side convergence",
    "wall_x_rad": "the wall's tilt along x", "wall_y_rad": "the wall's tilt along y",
    "rx_rad": "the inter-camera angle about its x", "ry_rad": "the inter-camera angle about its y",
    "rz_rad": "the inter-camera angle about its axis", "tx_mm": "the offset along x",
    "ty_mm": "the offset along y", "tz_mm": "the depth origin",
}  # fmt: skip


def _parameter_words(parameter: str) -> str:
    return _PARAMETER_WORDS.get(parameter, f"the distortion coefficient {parameter}")


COPY_CHANCE = 1e-9
"""Two images of independent noise agree as well as copies do at most with this probability."""
WINDOW = 3
"""Number of consecutive views that are solved together to find the offset of a camera's images."""
FARTHEST = 2
"""Largest offset, in views, that is tried."""
MOST_WINDOWS = 12
WORST_WINDOWS = 3
"""In so many windows, those that fit worst, other offsets are tried first."""
FAR_BETTER = 0.02
"""With the right offset the cost falls at least to this share."""


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
        copies = (common >= MINIMUM_DOTS) & (total < 2 * gammaincinv(common, COPY_CHANCE))
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


def wrong_pairs(problem: Problem, dots_mm: Array) -> str:
    """Return a sentence if a camera's images fit the views before or after far better, else "".

    A camera may have missed a trigger, or its first image was lost. Every few consecutive views are
    solved with one camera's images from up to `FARTHEST` views later or earlier.
    """
    count = len(problem.views)
    if count < WINDOW:
        return ""
    starts = np.unique(np.linspace(0, count - WINDOW, MOST_WINDOWS).round().astype(int))
    offsets = [s * n for n in range(1, FARTHEST + 1) for s in (1, -1)]
    own = np.array([_cost(problem, dots_mm, 0, v, 0) for v in starts])
    # a window that has no solution, for example without a shared view, proves nothing
    solved = np.flatnonzero(np.isfinite(own))
    for c in range(1, len(problem.cameras) if len(solved) else 0):
        cost = cache(partial(_cost, problem, dots_mm, c))
        # images of other views fit worst: if they are right even there, they are everywhere
        for some in (solved[np.sort(np.argsort(-own[solved])[:WORST_WINDOWS])], solved):
            costs = np.array([[cost(v, s) for s in offsets] for v in starts[some]])
            clear = costs.min(1) < FAR_BETTER * own[some]
            if not clear.any():
                break
        if not clear.any():
            continue
        best = costs.argmin(1)
        chosen = int(np.bincount(best[clear]).argmax())
        first = int(starts[some[clear & (best == chosen)]][0])
        camera, offset = problem.cameras[c].name, offsets[chosen]
        own_view, right_view = problem.views[first], problem.views[first + offset]
        side = "later" if offset > 0 else "earlier"
        return (
            f"from view {own_view!r} on, the images of camera {camera!r} do not belong to the "
            f"views whose names they have: those {abs(offset)} {side} fit (image {right_view!r} of "
            f"camera {camera!r} shows view {own_view!r}), so an image of one camera was lost or "
            "added"
        )
    return ""


def _cost(problem: Problem, dots_mm: Array, camera: int, first: int, offset: int) -> float:
    """Return the cost of `WINDOW` views with one camera's images ``offset`` later, or infinity."""
    last = first + WINDOW
    if not 0 <= first + offset <= len(problem.views) - WINDOW:
        return float(np.inf)
    mine = problem.camera == camera
    view = problem.view - np.where(mine, offset, 0) - first
    inside = (view >= 0) & (view < WINDOW)
    if camera and len(np.intersect1d(view[inside & mine], view[inside & ~mine])) < 2:
        return float(np.inf)  # two cameras can be turned so that any single view fits
    part = replace(
        problem.subset(inside),
        view=view[inside],
        views=problem.views[first:last],
        plate_shift=problem.plate_shift[first:last],
    ).with_model("none")
    try:
        starts = stereo_states(part, dots_mm)
        return min(solve(part, s, max_iterations=8, relative=1e-2).cost for s in starts)
    except TelerigError:
        return float(np.inf)
