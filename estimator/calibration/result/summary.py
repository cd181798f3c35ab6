"""A calibration in plain words, for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from telerig.io.results.calibration_words import telecentricity_words
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.io.results.calibration import CalibrationFile


def summary(calibration: CalibrationFile) -> str:
    """Return the summary of a `calibration.json` as text: verdict, residuals, parameters, notes."""
    s = calibration.statistics
    lines = [f"Calibration {calibration.name!r}: {calibration.verdict.status}"]
    lines += [f"  {words}" for words in telecentricity_words(s)]
    lines += [f"  ! {reason}" for reason in calibration.verdict.reasons]
    lines += _numbers(calibration) if "views" in s else _imported(calibration)
    return "\n".join(lines + [f"  note: {note}" for note in calibration.notes])


def _numbers(calibration: CalibrationFile) -> list[str]:
    """Return the lines on residuals, parameters, accuracy and the mirror ambiguity."""
    s, lines = calibration.statistics, list[str]()
    lines.append(
        f"  {counted(s['views'], 'view')}, {s['dots_kept']} of {s['dots_measured']} dots kept "
        f"({s['share_kept']:.1%}), residual {s['rms_px']:.4f} px RMS per coordinate, "
        f"chi-square {s['chi2_dof']:.2f} per degree of freedom"
    )
    if s["noise_floor_px"]:
        lines.append(
            f"  the dots scatter by {s['noise_floor_px']:.4f} px beyond their image noise of "
            f"{s['image_noise_px']:.4f} px (print, compression or lens); every covariance "
            "contains this scatter"
        )
    lines.append(f"  model {calibration.model.words}")
    for camera_name, camera in calibration.cameras.items():
        parts = [
            f"{name} {camera.parameters[name]:.6g} ± {deviation or 0.0:.2g}"
            for name, deviation in camera.standard_deviations.items()
        ]
        lines.append(f"  camera {camera_name}: " + ", ".join(parts))
    others = s.get("from_first") or ({"": s} if "axes_angle_deg" in s else {})
    first = next(iter(calibration.cameras))
    for other, angle in others.items():
        which = f" of {first} and {other}" if other else ""
        lines.append(
            f"  angle between the axes{which} {angle['axes_angle_deg']:.4f} ± "
            f"{angle['axes_angle_sd_deg']:.2g} degrees"
        )
    if "space_sd_um" in s:
        lines.append(
            f"  in space: dots {s['space_rms_um']:.2f} µm RMS from the fit; a point triangulated "
            f"from {s['scatter_px']:.3g} px is good to {s['space_sd_um']:.2f} µm per axis"
        )
    advice = calibration.diagnostics.next_view
    lines += [f"  {advice['words']}"] if advice else []
    t = calibration.twin
    lines.append(
        f"  mirror ambiguity: cost {_cost(t.cost)} of the kept solution, {_cost(t.other_cost)} of "
        f"its mirror image; decided by {t.decided_by}: {t.words}"
    )
    return lines


def _cost(cost: float | None) -> str:
    return "unknown" if cost is None else f"{cost:.9g}"


def _imported(calibration: CalibrationFile) -> list[str]:
    """Return the lines on cameras that another program calibrated: scale and kappa."""
    return [
        f"  camera {name}: {camera.parameters['scale_px_per_mm']:.6g} px/mm, "
        f"kappa {camera.parameters['kappa_per_mm']:.4g} per mm"
        for name, camera in calibration.cameras.items()
    ]
