"""telerig detect: find and number the dots of the calibration images."""

from __future__ import annotations

from telerig.scripts import options
from telerig.scripts.console import errors_in_words, progress, run_file, say, typed_command
from telerig.short_text import counted


@errors_in_words()
def detect(
    dataset: options.Dataset, out: options.CalibrationFolder = None, quiet: options.Quiet = False
) -> None:
    """Find and number the dots of the target in every calibration image.

    Writes dots.csv (every numbered dot with its covariance and chi-square), rejected.csv (what
    looked like a dot and was rejected, with the reason) and overlays/CAMERA/VIEW.jpg.

    Exit code 0: done. 2: the input cannot be used. 130: interrupted.
    """
    from telerig.estimator.calibration.results_folder import sources, write_detections
    from telerig.estimator.dots.dataset_dots import detect_dataset
    from telerig.io.dataset.dataset import load_dataset
    from telerig.io.files.csv_table import write_table
    from telerig.io.results.inputs import fingerprints
    from telerig.io.results.manifest import replaced_results

    data = load_dataset(dataset, source="images")
    folder = out or data.results / "calibration"
    inputs = fingerprints(folder, sources(data))
    again = typed_command("detect", data.path)
    with replaced_results(folder, "detect", again=again, inputs=inputs) as staged:
        with progress(quiet) as stage:
            found = detect_dataset(data, progress=lambda i, n: stage("images", i, n), overlays=True)
        write_table(found.dots, staged / "dots.csv")
        write_detections(found, staged)
    for image in found.images:
        result = (
            image.failure or f"{counted(len(image.dots), 'dot')}, {len(image.rejected)} rejected"
        )
        say(f"view {image.view}, camera {image.camera}: {result}")
    say(f"written: {folder}/dots.csv, rejected.csv, overlays/")


if __name__ == "__main__":
    run_file(detect)
