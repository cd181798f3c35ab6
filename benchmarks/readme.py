"""The figures of README.md and of benchmarks/README.md, made from the pages of the studies.

Usage: python benchmarks/readme.py [--write]

Each sentence is a function here that takes its numbers from `results/`, so that a figure stands in
one place, the page that its study wrote. Exit code 1 if a file differs; --write puts the sentences
into both. Pages that an earlier version of a study wrote may lack figures: they are named.
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

HERE = Path(__file__).parent
RESULTS = HERE / "results"
BEGIN, END = "<!-- figures: benchmarks/readme.py --write -->", "<!-- end of figures -->"


def text(name: str) -> str:
    return (RESULTS / f"{name}.md").read_text(encoding="utf-8")


def tables(name: str) -> dict[str, pd.DataFrame]:
    """A page's tables by the heading above them; the first of each heading, cells as text."""
    found: dict[str, pd.DataFrame] = {}
    heading, lines = "", text(name).splitlines()
    for k, line in enumerate(lines):
        if line.startswith("#"):
            heading = line.lstrip("# ").strip()
        elif line.startswith("|---") and heading not in found:
            rows = []
            for below in lines[k + 1 :]:
                if not below.startswith("|"):
                    break
                rows.append(cells(below))
            found[heading] = pd.DataFrame(rows, columns=cells(lines[k - 1]))
    return found


def cells(line: str) -> list[str]:
    return [cell.strip().strip("*").strip() for cell in line.strip().strip("|").split("|")]


def table(name: str, heading: str = "") -> pd.DataFrame:
    """The table below the first heading that begins so."""
    for title, found in tables(name).items():
        if title.startswith(heading):
            return found
    raise SystemExit(f"results/{name}.md has no table under '{heading}'")


def number(words: str) -> float:
    """The first number of a cell."""
    found = re.search(r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?", words)
    return float(found[0].replace(",", "")) if found else np.nan


def numbers(column: pd.Series) -> np.ndarray:
    return np.array([number(words) for words in column])


def span(values: np.ndarray, digits: int) -> str:
    low, high = f"{np.min(values):.{digits}f}", f"{np.max(values):.{digits}f}"
    return low if low == high else f"{low}-{high}"


def said(name: str, pattern: str) -> tuple[str, ...]:
    """The groups of a pattern in a page."""
    found = re.search(pattern, text(name))
    if not found:
        raise SystemExit(f"results/{name}.md does not say '{pattern}'")
    return found.groups()


def link(name: str, words: str = "results") -> str:
    return f"[{words}](benchmarks/results/{name}.md)"


def dots() -> str:
    t = table("dots")
    off = np.abs(numbers(t["cov"]) - 1).max()
    return (
        f"RMS {span(numbers(t['rms']), 2)} times the Cramer-Rao bound over {len(t)} kinds of "
        f"picture, reported covariance right to {100 * off:.0f} % ({link('dots')})."
    )


def paper() -> str:
    (seeds,) = said("paper", r"from images, (\d+) seeds")
    dots, missing, wrong = said("paper", r"inside: (\d+), missing (\d+), wrongly numbered (\d+)")
    error, ratio = said("paper", r"median ([\d.]+), bound [\d.]+; .*root mean square ([\d.]+)")
    gain = numbers(table("print_errors").query("`dots off by µm` == '20'").iloc[:, 5])
    right = int(dots) - int(missing) - int(wrong)
    return (
        f"Twelve views of 15 dots from images, {seeds} rigs not tuned to: {right:,} of "
        f"{int(dots):,} dots found and rightly numbered; 3-D error {number(error):.2f} µm RMS per "
        f"axis over a 30 mm volume (median), root mean square {number(ratio):.2f} of what the "
        f"covariance predicts ({link('paper')}). Dots held at their nominal places (20 µm print "
        f"errors) are {span(gain, 0)} times worse ({link('print_errors', 'print errors')})."
    )


def covariance() -> str:
    t = table("covariance")
    outside = numbers(t["outside 99.9 %"]).sum()
    total = sum(int(words.split("of")[1]) for words in t["outside 99.9 %"])
    (pooled,) = said("covariance", r"reported over observed \*\*([\d.]+ \+- [\d.]+)\*\*")
    right = [m for m in t["model"] if "too simple" not in m]
    return (
        f"Reported standard deviations over observed ones: {pooled}, pooled over simulated "
        f"calibrations of {len(right)} kinds; {outside:.0f} of {total} quantities outside their "
        f"99.9 % interval ({link('covariance')})."
    )


def ladder() -> str:
    t = table("ladder", "Sizes three times")
    (first, last) = said("ladder", r"detectable and more: seeds (\d+) to (\d+)")
    rigs = int(last) - int(first) + 1
    right = np.rint(numbers(t["right"]) / 100 * rigs).sum()
    return (
        f"Chosen camera by camera: {right:.0f} of {rigs * len(t)} simulated rigs "
        "right where its parameters are three times detectable or more, too simple more often than "
        f"not below that ({link('ladder')})."
    )


def stress() -> str:
    t = table("stress")
    # The lens of that row has a term that its model has not: shown there, and not a claim.
    t = t[~(t["case"].str.startswith("30-100") & (t["model"] == "tangential"))]
    auto = t["model"].str.startswith("auto")
    ratio = numbers(t["RMS / bound"])
    return (
        "Both kinds, 20 to 160 degrees between the cameras, views of 30-100 % of "
        f"the target, 5 % gross outliers: 3-D error {span(ratio[~auto], 2)} times its Cramer-Rao "
        f"bound with the lens model given, {span(ratio[auto], 2)} with `--model auto` "
        f"(fewer seeds) ({link('stress')})."
    )


def bubbles() -> str:
    t = table("bubbles", "Rendered")
    pair = table("bubble_pair", "The real pair").query("method == 'telerig'").iloc[-1]
    (listed,) = said("bubble_pair", r"\| 1 \| (\d+ of \d+) \|")
    (offset,) = said("bubble_pair", r"cameras differ by \+?(-?[\d.]+) px")
    off = np.abs(numbers(t["cov"]) - 1).max()
    return (
        f"Outline centres at {span(numbers(t['rms']), 2)} times the Cramer-Rao bound, "
        f"covariance right to {100 * off:.0f} % ({link('bubbles')}). On a real pair of another "
        f"laboratory {listed} listed bubbles are found, {pair['sound']} sound pairs are matched, "
        f"{pair['unsound']} unsound ones, and the {number(offset):.0f} px error of its calibration "
        f"is found and reported ({link('bubble_pair')})."
    )


def bodies() -> str:
    t = table("bodies")
    zonal = t[(t["mode"] == "3,0") & (t["axis"] == "vertical") & (t["ratio"] == "1")].iloc[0]
    apart = t[t["mode"].str.startswith("3,") & (t["axis"] == "apart")]
    less = 100 * (1 - 1 / numbers(apart["gain"]))
    return (
        "Modes of degree 3 move an outline's centre off the centre of volume; two views see "
        "this along the shared coordinate, not across it. With modes of 5 % that are axisymmetric "
        "about the vertical the error falls from "
        f"{number(zonal['mean of outlines, µm']):.0f} µm to "
        f"{number(zonal['volume, µm']):.0f}, about random axes by {span(less, 0)} % "
        f"({link('bodies')})."
    )


def swarms() -> str:
    t = table("bubble_runs")
    swaps = numbers(t["swaps"]).sum()
    return (
        f"20 bubbles, {len(t)} runs not tuned to: recall "
        f"{span(numbers(t['recall']), 3)} of all that both images show whole, precision "
        f"{span(numbers(t['precision']), 3)}, {swaps:.0f} identities swapped "
        f"({link('bubble_runs')})."
    )


def crossings() -> str:
    parts = []
    for rate in ("500 Hz", "100 Hz"):
        t = table("crossings", f"Crossing: {rate}, both").set_index("")
        ours, plain, peer = t.loc["telerig"], t.loc["plain prediction"], t.loc["trackpy.link"]
        parts.append(
            f"{number(ours['swaps %']):g} % of {ours['events']} at {rate}, "
            f"{number(ours['breaks %']):g} % broken rather than guessed (plain prediction swaps "
            f"{number(plain['swaps %']):.0f} %, trackpy {number(peer['swaps %']):.0f} %)"
        )
    return (
        f"Identity swaps in close passes of zigzagging bubbles: {'; '.join(parts)} "
        f"({link('crossings')})."
    )


def shake() -> str:
    t = table("shake_scenarios")
    gain = numbers(t["naive / RMS"])
    ratio = numbers(t["RMS / possible"])
    nees = numbers(t["NEES 3-D"])
    verdicts = table("identifiability").query("information == 'one'")
    one = verdicts[~verdicts["case"].isin(["S0", "S5"])]["verdicts"]
    counts: Counter[str] = Counter()
    for cell in one:
        for number, verdict in re.findall(r"(\d+) ([A-Z]+)", cell):
            counts[verdict] += int(number)
    shares = ", ".join(f"{n} of {counts.total()} axes are {v}" for v, n in sorted(counts.items()))
    return (
        "With hyper-parameters given, the graph equals an independent Kalman smoother to "
        "1e-6 for every set of sensors. With marks fixed to the tank or an accelerometer on each "
        "arm, and hyper-parameters at their defaults, paths of a shaking rig are "
        f"{span(gain, 1)} times better than triangulating and adding the encoder, at "
        f"{span(ratio, 2)} times the error that is possible, NEES {span(nees, 2)} "
        f"({int(numbers(t['runs']).sum())} runs: {link('shake_scenarios')}). With one bubble and "
        f"an encoder alone, where the rig shakes, {shares} "
        f"({link('shake_table', 'what is possible')}, {link('identifiability', 'verdicts')})."
    )


def physics() -> str:
    t = table("bubble_physics")
    frame = t[(t["motion"] == "smoothed") & (t["per"] == "frame")].set_index("number")
    given = t[(t["motion"] == "motion given") & (t["per"] == "frame")]
    bubble = t[(t["motion"] == "smoothed") & (t["per"] == "bubble")].set_index("number")
    drag = frame.loc["drag"]
    percent = abs(number(drag["bias, %"]))
    bias = f"{percent:.2f} %" if percent >= 0.01 else "less than 0.01 %"
    velocity = numbers(frame.loc[[n for n in frame.index if re.match(r"[va][xyz]_", n)]]["NEES"])
    means = {"diameter": "d_eq_mm", "aspect ratio": "aspect", "rise velocity": "rise_mm_s",
             "slip velocity": "slip_mm_s", "drag": "drag"}  # fmt: skip
    listed = ", ".join(f"{words} {number(bubble.loc[n]['NEES']):.2f}" for words, n in means.items())
    return (
        "Simulated bubbles that obey Clift's drag law in a shaking "
        f"rig have their drag coefficient back with a bias of {bias}. NEES in a frame: "
        f"{span(numbers(given['NEES']), 2)} where the motion is given, "
        f"{span(velocity, 2)} for smoothed velocities and accelerations, "
        f"{number(drag['NEES']):.2f} for drag. Of means over a bubble: {listed} "
        f"(above 1: stated too well; {link('bubble_physics')})."
    )


def start() -> str:
    right, rigs = said("initialisation", r"\*\*(\d+) of (\d+)\*\* rigs")
    return (
        "The closed-form start is in the right basin and on the right side for "
        f"{right} of {rigs} random rigs ({link('initialisation')})."
    )


def cameras() -> str:
    ratio, pair = said(
        "three_cameras", r"axis, ([\d.]+ ± [\d.]+) times.*\(([\d.]+) times as much\)"
    )
    nees, seeds = (
        said("three_cameras", r"NEES ([\d.]+ ± [\d.]+) of points")[0],
        len(table("three_cameras")),
    )
    many = table("many_cameras")
    every = many[many["cameras"] == "all"]
    pairs = many[many["cameras"].str.contains(" and ")]
    still = every[every["scene"].str.contains("no shake")]
    error = [number(words.split(",")[1]) for words in still["error (µm), median"]]
    two = pairs[pairs["scene"].str.contains("no shake")]["error (µm), median"]
    bound = numbers(every["over the bound"])
    return (
        "At 0, 60 and 120 degrees, from images: points at "
        f"{ratio} times their Cramer-Rao bound, {pair} times as good as from the best pair of "
        f"them, NEES {nees} ({seeds} seeds: {link('three_cameras')}). Swarms of 20 and 60 bubbles "
        f"tracked with three and four cameras: {span(numbers(every['recall']), 3)} of the bubbles "
        f"that two cameras see whole have their point (the best pair alone: "
        f"{span(numbers(pairs['recall']), 2)}), {numbers(every['swaps']).sum():.0f} identities are "
        f"swapped. Without shake they place a bubble to {span(np.array(error), 2)} µm where two of "
        f"them do to {span(np.array([number(w.split(',')[1]) for w in two]), 1)} (medians); "
        f"outlines alone are at {span(bound[np.isfinite(bound)], 1)} times their Cramer-Rao bound "
        f"({link('many_cameras')})."
    )


def solvers() -> str:
    t = table("solvers").set_index("views x dots")
    seconds = {k: number(t.loc[k]["gtsam"]) for k in ("12x15", "12x100")}
    large = t.loc["200x400"]["numpy"]
    scipy = [number(r["scipy"]) / number(r[ours]) for _, r in t.iterrows()
             for ours in ("gtsam", "numpy") if np.isfinite(number(r["scipy"]))]  # fmt: skip
    return (
        f"GTSAM solves 12 views of 15 dots in two cameras in {1e3 * seconds['12x15']:.0f} ms of "
        f"CPU, 12 of 100 in {1e3 * seconds['12x100']:.0f} ms; from 5,000 measured dots on NumPy "
        f"eliminates the dots: 200 views of 400 dots in {number(large):.1f} s. SciPy's sparse "
        f"least squares with the same derivatives takes {span(np.array(scipy), 0)} times as long "
        f"to the same cost ({link('solvers')})."
    )


def windows() -> str:
    return (
        "Glass and water are modelled exactly, to 3e-13 px of an independent ray tracer "
        "([how](docs/howto/glass.md))."
    )


def paper_2004() -> str:
    t = table("paper_2004").set_index("figure")["telerig"]
    return (
        "The figures of Coudert et al. (ISFV11, 2004; the work from which telerig started, see "
        "[`CITATION.cff`](CITATION.cff)) under its own inputs: dots 0.03 -> "
        f"{number(t['dots, from images']):.3f} px, the bubble's centre 1.5 -> "
        f"{number(t[next(k for k in t.index if 'centre' in k)]):.2f} px, its place 0.5 -> "
        f"{number(t['bubble overall, arm accelerometers']):.3f} mm ({link('paper_2004')})."
    )


def real_images() -> str:
    t = table("real_images")
    free = t[t["dots"] == "3d"].iloc[0]
    return (
        "14 stereo pairs of a printed target, lenses that are *not* telecentric: "
        f"dots agree with the model to {number(free['RMS px']):.3f} px RMS, and the report finds "
        f"that the print is out of plane by {number(free['out of plane µm']):.0f} µm "
        f"({link('real_images')})."
    )


SENTENCES: dict[Path, dict[str, Callable[[], str]]] = {
    HERE.parent / "README.md": {
        "Dots": dots,
        "Calibration": paper,
        "Covariance": covariance,
        "Bubbles": bubbles,
        "Swarms": swarms,
        "Crossings": crossings,
        "Shake": shake,
        "Before telerig": paper_2004,
        "Real images": real_images,
    },
    HERE / "README.md": {
        "Lens models": ladder,
        "Tilted sensors": stress,
        "Start": start,
        "Three and four cameras": cameras,
        "Solvers": solvers,
        "Windows": windows,
        "Centre of volume": bodies,
        "Sizes and forces": physics,
    },
}
"""The first are what a newcomer asks; the others stand beside the list of studies."""


def block(file: Path) -> str:
    """A file's part with its sentences. SystemExit names the pages that lack a figure."""
    made, missing = [], []
    for about, sentence in SENTENCES[file].items():
        try:
            made.append(f"- **{about}.** {sentence()}")
        except (SystemExit, LookupError, StopIteration, ValueError) as error:
            missing.append(f"{about}: {error}")
    if missing:
        raise SystemExit("run these studies again (benchmarks/all.py):\n" + "\n".join(missing))
    text = "\n".join([BEGIN, "", *made, "", END])
    if file.parent == HERE:
        text = text.replace("](benchmarks/", "](").replace("](docs/", "](../docs/")
    return text


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true")
    write = parser.parse_args().write
    differ = False
    for file in SENTENCES:
        name, now = str(file.relative_to(HERE.parent)), file.read_text(encoding="utf-8")
        if now.count(BEGIN) != 1 or now.count(END) != 1:
            raise SystemExit(f"{name} needs one line '{BEGIN}' and one '{END}'")
        made = now[: now.index(BEGIN)] + block(file) + now[now.index(END) + len(END) :]
        if made == now:
            print(f"{name}: the figures are those of the pages")
        elif write:
            file.write_text(made, encoding="utf-8")
            print(f"{name}: the figures are written anew")
        else:
            differ = True
            lines = difflib.unified_diff(now.splitlines(True), made.splitlines(True), name, "pages")
            sys.stdout.writelines(lines)
    return int(differ)


if __name__ == "__main__":
    sys.exit(main())
