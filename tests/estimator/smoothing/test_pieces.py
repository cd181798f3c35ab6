"""A run smoothed in pieces, against the joint solution of the same run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import shake_problem
from numpy.typing import NDArray
from seeds import first_or_all
from shake_cases import SCENARIOS, generate
from shake_learning_data import run, true_model, with_comings_and_goings

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.smoothing import pieces as pieces_module
from telerig.estimator.smoothing.graph.layout import clocks_of
from telerig.estimator.smoothing.graph.solve import Options, Solution, drawn, solve
from telerig.estimator.smoothing.pieces import (
    Constants,
    Piece,
    first_round,
    piece_with_most,
    pieces_of,
    solved_pieces,
    with_clock_numbers,
)
from telerig.estimator.smoothing.problem.problem import (
    CalibrationShare,
    ShakeModel,
    SmoothingProblem,
)
from telerig.estimator.smoothing.results_file import ResultsFile, StoredTables, Tables, results_file
from telerig.estimator.smoothing.unfinished import UnfinishedPieces
from telerig.estimator.smoothing.verdict.contradiction import contradictions
from telerig.estimator.smoothing.verdict.evidence import Evidence, Span, evidence_of
from telerig.io.files.hdf5 import hdf5_file
from telerig.io.files.typed_json import packed
from telerig.io.results.smoothing import Disagreement

pytestmark = pytest.mark.usefixtures("known_low_passes")

Array = NDArray[np.float64]
PLAIN = Options(robust=False, draws=True)
AXES = "xyz"


def with_calibration(problem: SmoothingProblem) -> SmoothingProblem:
    """The cameras' scales and the pose between them are known to some 1e-3."""
    free = (("scale_px_per_mm",), ("scale_px_per_mm",))
    root = 1e-3 * np.eye(8)
    return replace(problem, calibration=CalibrationShare(root, free, root @ root.T))


def crowded(frames: int = 600, marks: int = 0) -> tuple[SmoothingProblem, ShakeModel]:
    problem, *_ = run(np.random.default_rng(3), bubbles=3, seconds=frames / 200, marks=marks)
    cut = with_comings_and_goings(problem, np.random.default_rng(4), frames // 3)
    return with_calibration(cut), true_model()


def sensed(information: str) -> tuple[SmoothingProblem, ShakeModel]:
    scenario = replace(SCENARIOS["S2"], frames=900 if information == "references" else 600)
    runs = generate(scenario, 1, np.random.default_rng(5))
    model = shake_problem.true_model(scenario, information)
    return shake_problem.problem(scenario, information, runs), model


def silent(_what: str, _share: float) -> None:
    """Report nothing."""


def constants_of(
    problem: SmoothingProblem, model: ShakeModel, pieces: Sequence[Piece]
) -> Constants | None:
    own = [piece.without_margin() for piece in pieces]
    told = (told for _, told in first_round(problem, model, own, PLAIN, silent))
    return Constants.of(problem, model, pieces, told)


def sigma(solution: Solution, rows: Array) -> Array:
    found = solution.covariances
    assert found is not None
    return np.asarray(np.sqrt(np.einsum("id,nde,ie->ni", rows, found.bubbles, rows)))


@pytest.mark.parametrize(
    "made",
    [
        pytest.param(crowded, id="calibration"),
        pytest.param(lambda: sensed("references"), id="marks"),
        pytest.param(lambda: sensed("arms"), id="accelerometers", marks=pytest.mark.slow),
    ],
)
def test_paths_and_sums_are_those_of_the_joint_solution(
    made: Callable[[], tuple[SmoothingProblem, ShakeModel]],
) -> None:
    problem, model = made()
    joint = solve(problem, model, PLAIN)
    pieces = pieces_of(problem, model, -(-len(problem.t_s) // 3))
    assert len(pieces) == 3
    constants = constants_of(problem, model, pieces)
    graph, at = joint.graph, joint.graph.bubble.position
    seen, parts = np.zeros(graph.rows, bool), []
    for piece, window, solution in solved_pieces(problem, model, pieces, PLAIN, silent, constants):
        span = Span(piece.own, piece.low, problem.t_s)
        mine = np.flatnonzero(span.holds(solution.graph.frame_of_row))
        here = solution.graph
        rows = graph.row(
            window.bubbles[here.bubble_of_row[mine]], here.frame_of_row[mine] + piece.low
        )
        assert not seen[rows].any()
        seen[rows] = True
        off = (solution.state.bubbles[mine] - joint.state.bubbles[rows]) @ at.T
        stated = sigma(joint, at)[rows]
        assert np.sqrt(np.mean((off / stated) ** 2)) < 0.07
        np.testing.assert_allclose(sigma(solution, at)[mine] / stated, 1, atol=0.02)
        parts.append(Evidence.of(solution, drawn(solution), span))
    assert seen.all()
    total, whole = evidence_of(parts), Evidence.of(joint, drawn(joint))
    assert total.nodes == whole.nodes
    assert set(total.means) == set(whole.means)
    assert total.pixels["bubbles"].count == whole.pixels["bubbles"].count
    assert total.pixels["bubbles"].total == pytest.approx(whole.pixels["bubbles"].total, rel=5e-3)
    for key, tally in whole.tallies.items():
        assert total.tallies[key].count == tally.count
        assert abs(total.tallies[key].seen.sum() - tally.seen.sum()) < 0.01 * tally.count
    assert total.shake is not None and whole.shake is not None
    assert total.shake.frames == whole.shake.frames
    for one, other in zip(total.shake.square, whole.shake.square):
        np.testing.assert_allclose(one, other, rtol=0.01)


def test_what_all_pieces_tell_of_the_calibration_is_what_the_joint_solution_knows() -> None:
    problem, model = crowded()
    pieces = pieces_of(problem, model, 200)
    constants = constants_of(problem, model, pieces)
    joint = solve(problem, model, replace(PLAIN, constants=True))
    assert constants is not None and joint.constants is not None
    spread = np.sqrt(np.diag(joint.constants))
    assert np.max(np.abs(constants.mean - joint.state.calibration) / spread) < 0.05
    # without their margins, pieces tell a little less than the run does
    known = np.sqrt(np.diag(np.linalg.inv(constants.total)))
    np.testing.assert_allclose(known / spread, 1, atol=0.05)


def test_a_run_that_fits_into_memory_is_one_piece() -> None:
    problem, model = crowded()
    (piece,) = pieces_of(problem, model)
    assert (piece.first, piece.end, piece.low, piece.high) == (0, 600, 0, 600)
    assert piece.cut(problem).problem is problem


def tracks_of(problem: SmoothingProblem) -> pd.DataFrame:
    """The pixels of a problem whose bubbles are seen in all of their frames, as tracks."""
    table = pd.concat(
        pd.DataFrame({"frame": np.arange(b.first, b.last + 1), "particle": b.particle})
        for b in problem.bubbles
    ).reset_index(drop=True)
    table["t_s"] = problem.t_s[table["frame"]]
    table[["x_mm", "y_mm", "z_mm"]] = np.concatenate([b.guess_mm for b in problem.bubbles])
    particle = np.array([b.particle for b in problem.bubbles])
    for index, camera in enumerate(problem.cameras):
        seen = problem.observations.of(problem.observations.camera == index)
        pixels = {"frame": seen.frame, "particle": particle[seen.item]}
        pixels |= {f"{camera.name}_{n}_px": seen.uv_px[:, i] for i, n in enumerate("uv")}
        for name, i, j in (("suu", 0, 0), ("suv", 0, 1), ("svv", 1, 1)):
            pixels[f"{camera.name}_{name}_px2"] = seen.covariance_px2[:, i, j]
        table = table.merge(pd.DataFrame(pixels), on=["frame", "particle"])
    table["d_eq_mm"] = table["sd_eq_mm"] = 1.5
    return table.sort_values(["frame", "particle"], ignore_index=True)


def marks_of(problem: SmoothingProblem) -> pd.DataFrame:
    """The pixels of a problem's marks as a table like references.csv."""
    seen = problem.references
    table = pd.DataFrame({"frame": seen.frame, "mark": [f"m{k}" for k in seen.item]})
    table["camera"] = [problem.cameras[c].name for c in seen.camera]
    table["u_px"], table["v_px"] = seen.uv_px.T
    return table


def test_tables_in_a_file_are_those_of_memory(tmp_path: Path) -> None:
    problem, _ = crowded(120)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    whole, parts = (
        telerig.smooth(
            tracks_of(problem), calibration, model="default", t_s=problem.t_s,
            options=Options(frames=n),
        )
        for n in (None, 60)
    )  # fmt: skip
    assert parts.verdict["verdict"] == whole.verdict["verdict"]
    assert parts.summary["bubbles"] == whole.summary["bubbles"]
    assert whole.facts()["bubbles"] == parts.facts()["bubbles"]
    key = ["particle", "frame"]
    one, other = (s.trajectories.sort_values(key, ignore_index=True) for s in (whole, parts))
    assert list(one) == list(other)
    pd.testing.assert_frame_equal(one[[*key, "t_s"]], other[[*key, "t_s"]])
    for axis in AXES:
        # how near pieces come is measured above, in longer ones
        off = (one[f"{axis}_mm"] - other[f"{axis}_mm"]) / one[f"s{axis}_mm"]
        assert np.sqrt(np.mean(off**2)) < 0.1
    assert list(whole.shake) == list(parts.shake)
    np.testing.assert_array_equal(whole.shake["frame"], parts.shake["frame"])
    assert parts.solution is None
    for found, place in ((whole, tmp_path / "whole"), (parts, tmp_path / "parts")):
        found.save(place)
    again = telerig.load_smoothing(tmp_path / "parts")
    assert isinstance(again.tables, StoredTables)
    for name in ("trajectories", "shake"):
        written = pd.read_csv(tmp_path / "parts" / f"{name}.csv")
        pd.testing.assert_frame_equal(getattr(again, name), written, rtol=1e-8)
    np.testing.assert_array_equal(again.trajectories["x_mm"], parts.trajectories["x_mm"])
    assert set(again.states) == set(whole.states)
    np.testing.assert_array_equal(again.states["bubbles"], parts.states["bubbles"])
    for name in ("bubbles", "bubble_summary"):
        one, other = (pd.read_csv(tmp_path / p / f"{name}.csv") for p in ("whole", "parts"))
        assert list(one) == list(other)
        assert len(one) == len(other)
        np.testing.assert_allclose(other["d_eq_mm"], 1.5)


def test_a_bubble_that_no_camera_sees_in_a_piece_has_rows_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _, _ = run(np.random.default_rng(3), bubbles=2, seconds=0.4)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    table = tracks_of(problem)
    hidden = (table["particle"] == 0) & table["frame"].between(20, 59)
    table = table[~hidden].reset_index(drop=True)
    joint, found = (
        telerig.smooth(
            table, calibration, model="default", t_s=problem.t_s, options=Options(frames=n)
        )
        for n in (None, 10)
    )
    paths, expected = (
        s.trajectories[s.trajectories["particle"] == 0].set_index("frame") for s in (found, joint)
    )
    assert paths.index.tolist() == expected.index.tolist() == list(range(80))
    out_of_sight = slice(30, 49)
    for axis in AXES:
        wide = expected[f"s{axis}_mm"][out_of_sight]
        np.testing.assert_array_less(paths[f"s{axis}_mm"][out_of_sight] / wide, 2.5)
        off = (paths[f"{axis}_mm"] - expected[f"{axis}_mm"])[out_of_sight]
        np.testing.assert_array_less(np.abs(off / wide), 1.0)
    found.save(tmp_path / "out")
    written = pd.read_csv(tmp_path / "out" / "bubble_summary.csv")
    seen = table.groupby("particle")["frame"].agg(["min", "max"])
    assert written["particle"].tolist() == seen.index.tolist()
    assert written["first_frame"].tolist() == seen["min"].tolist()
    assert written["last_frame"].tolist() == seen["max"].tolist()
    monkeypatch.setattr(pieces_module, "_ROWS", 1)
    monkeypatch.setattr(pieces_module, "_FRAMES", 10)
    alone = telerig.smooth(
        table, calibration, model="default", t_s=problem.t_s, options=Options(frames=10)
    )
    assert len(alone.trajectories) == len(found.trajectories), "rows are there without room, too"


def test_a_shake_without_bubbles_is_smoothed_in_pieces(tmp_path: Path) -> None:
    problem, _ = crowded(200)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    stage = {"t_s": problem.t_s, "position_mm": 0 * problem.t_s}
    found = telerig.smooth(
        None, calibration, stage=stage, t_s=problem.t_s, model="default",
        options=Options(frames=100),
    )  # fmt: skip
    assert len(found.shake) == 200
    assert not len(found.trajectories)
    found.save(tmp_path)
    assert len(telerig.load_smoothing(tmp_path).shake) == 200


@pytest.mark.parametrize("frames", first_or_all(100, None))
def test_bubbles_that_come_late_are_judged(frames: int | None, tmp_path: Path) -> None:
    problem, _ = crowded(300)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    table = tracks_of(problem)
    found = telerig.smooth(
        table[table["frame"] >= 215].reset_index(drop=True), calibration, t_s=problem.t_s,
        model="default", options=Options(frames=frames), folder=str(tmp_path),
    )  # fmt: skip
    assert found.verdict["verdict"] in ("RESOLVED", "PARTIAL", "UNRESOLVED")
    assert found.summary["acceleration_bandwidth_hz"]
    assert set(found.trajectories[["frame", "particle"]].dtypes) == {np.dtype(np.int64)}


def test_an_encoder_that_covers_a_part_of_the_run() -> None:
    """Where it does not, the carriage is unknown with and without shake, which is no separation."""
    problem, _ = crowded(80)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    t = problem.t_s[:20]
    words = [
        telerig.smooth(
            tracks_of(problem), calibration, stage={"t_s": t, "position_mm": 0.2 * t},
            t_s=problem.t_s, model="default", options=Options(frames=n),
        ).verdict["verdict"]
        for n in (None, 40)
    ]  # fmt: skip
    assert words == ["UNRESOLVED", "UNRESOLVED"]


def test_sensors_share_clocks_in_pieces_as_they_do_in_the_run() -> None:
    problem, model = sensed("arms")
    left, right = problem.accelerometers
    short = replace(problem, accelerometers=(left, right.of(slice(0, -1))))
    pieces = pieces_of(short, model, 200)
    assert clocks_of(short).tolist() == [0, 1]
    assert clocks_of(pieces[0].cut(short).problem).tolist() == [0, 0], "the reason for the numbers"
    numbered = with_clock_numbers(short)
    for piece in pieces:
        assert clocks_of(piece.cut(numbered).problem).tolist() == [0, 1]


def test_only_standard_deviations_are_widened(tmp_path: Path) -> None:
    names = ["front_y_mm", "side_y_mm", "sfront_y_mm", "sside_y_mm"]
    shake = pd.DataFrame({name: np.ones(3) for name in names})
    with hdf5_file(tmp_path / "piece.h5") as made:
        piece = ResultsFile(made)
        piece.append(Tables(shake.iloc[:0], shake))
        piece.finish((1.0, 1.0, 1.0))
    with results_file(tmp_path) as file, h5py.File(tmp_path / "piece.h5", "r") as written:
        file.append_piece(written, (2.0, 3.0, 4.0))
        found = [float(file.file["shake"][name][0]) for name in names]
    assert found == [1.0, 1.0, 3.0, 3.0]


def test_an_interrupted_smoothing_goes_on_with_the_pieces_that_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of four pieces is solved twice, first for the places of the marks."""
    problem, _ = crowded(240, marks=1)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    stop, solved, said = 0, list[int](), list[str]()

    def counted(problem: SmoothingProblem, model: ShakeModel, options: Options) -> Solution:
        solved.append(len(problem.t_s))
        if len(solved) == stop:
            raise KeyboardInterrupt
        return solve(problem, model, options)

    monkeypatch.setattr(pieces_module, "solve", counted)

    def smoothed(folder: str, key: str = "a") -> telerig.Smoothing:
        solved.clear()
        said.clear()
        return telerig.smooth(
            tracks_of(problem), calibration, model="default", t_s=problem.t_s,
            references=marks_of(problem), options=Options(frames=60),
            unfinished=UnfinishedPieces(tmp_path / folder, key),
            progress=lambda what, _share, _of: said.append(what.partition("frames: ")[2]),
        )  # fmt: skip

    def going_on() -> list[str]:
        return [what for what in said if "going on" in what]

    whole = smoothed("whole")
    assert len(solved) == 8 and not going_on()
    of_first_round = "what is constant along the run, going on, {} of 4 pieces are finished"
    stop = 3
    with pytest.raises(KeyboardInterrupt):
        smoothed("parts")
    assert not going_on()
    stop = 5
    with pytest.raises(KeyboardInterrupt):
        smoothed("parts")
    assert going_on() == [of_first_round.format(2)]
    stop = 0
    again = smoothed("parts")
    assert len(solved) == 2
    assert going_on() == [of_first_round.format(4), "going on, 2 of 4 pieces are finished"]
    for name in ("trajectories", "shake", "bodies"):
        pd.testing.assert_frame_equal(getattr(again, name), getattr(whole, name))
    np.testing.assert_array_equal(
        again.states["bubble_covariance"], whole.states["bubble_covariance"]
    )
    assert again.verdict == whole.verdict
    first, second = (packed({**s.summary, "seconds": 0}) for s in (again, whole))
    assert first == second
    stop = 1
    with pytest.raises(KeyboardInterrupt):
        smoothed("parts", "b")
    assert not going_on(), "pieces of other inputs are not used"


def test_pieces_for_which_the_disk_has_no_room_are_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _ = crowded(120)
    rows = sum(map(len, problem.bubbles))
    asked = dict[Path, float]()

    def free(folder: Path) -> float:
        return asked.setdefault(folder, 3900.0 * rows)

    monkeypatch.setattr("telerig.io.machine.room.free_bytes", free)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    with pytest.raises(InputError, match="on the disk") as caught:
        telerig.smooth(
            tracks_of(problem), calibration, model="default", t_s=problem.t_s,
            options=Options(frames=60), folder=tmp_path,
        )  # fmt: skip
    assert "fewer frames" in caught.value.todo
    assert list(asked) == [tmp_path]
    assert not list(tmp_path.iterdir())


def test_pieces_of_an_interrupted_call_are_not_taken_for_those_of_other_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _ = crowded(120)
    calibration = calibration_from_cameras(list(problem.cameras), name="truth")
    tracks = tracks_of(problem)

    def smoothed(table: pd.DataFrame, **options: Path) -> telerig.Smoothing:
        return telerig.smooth(
            table, calibration, model="default", t_s=problem.t_s, options=Options(frames=60),
            **options,
        )  # fmt: skip

    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("telerig.estimator.smoothing.smooth.evidence_of", interrupted)
        with pytest.raises(KeyboardInterrupt):
            smoothed(tracks, folder=tmp_path)
    assert list(tmp_path.iterdir()) == []
    other = tracks.assign(left_u_px=tracks["left_u_px"] + 0.5)
    found, expected = smoothed(other, folder=tmp_path), smoothed(other)
    pd.testing.assert_frame_equal(found.trajectories, expected.trajectories)
    assert [file.name for file in tmp_path.iterdir()] == ["results.h5"]


def test_a_sensor_of_another_piece_than_the_middle_one_is_held_against_its_prior() -> None:
    """It reads 3 m/s^2 too much, fifteen times what is known of its bias, and soon ends."""
    problem, model = sensed("arms")
    left, right = problem.accelerometers
    short = right.t_s < problem.t_s[40]
    ending = replace(right.of(short), reading_mm_s2=right.reading_mm_s2[short] + [0, 3000.0, 0])
    problem = with_clock_numbers(replace(problem, accelerometers=(left, ending)))
    pieces = pieces_of(problem, model, 100)
    constants = constants_of(problem, model, pieces)
    chosen = [0, piece_with_most(problem, pieces)]
    parts = list[Evidence]()
    for piece, _, solution in solved_pieces(
        problem, model, pieces, PLAIN, silent, constants, chosen
    ):
        span = Span(piece.own, piece.low, problem.t_s)
        parts.append(Evidence.of(solution, drawn(solution), span))
    assert [s.name for s in solution.graph.problem.accelerometers] == [left.name]
    found = contradictions(solution, evidence_of(parts)).found
    assert (right.name, Disagreement.BIAS) in {(one.source, one.test) for one in found}
