"""Text files as a dozen makers' loggers and programs write them: headers, units, clocks, marks.

The headers follow the makers' formats; the numbers below them are made here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.exchange.importing.accelerometer import (
    Layout,
    import_accelerations,
    read_accelerations,
)
from telerig.rig.units import STANDARD_GRAVITY_M_S2 as G

Array = NDArray[np.float64]

RATE_HZ = 100.0
T_S = np.arange(300) / RATE_HZ
A_G = np.stack([0.3 * np.sin(20 * T_S), 0.2 * np.cos(9 * T_S), 1 + 0.1 * np.sin(30 * T_S)], -1)
START = datetime(2024, 3, 9, 23, 59, 58)


def lines(
    head: Iterable[str],
    first: Iterable[object],
    readings: Array = A_G,
    mark: str = ",",
    more: str = "",
    digits: int = 6,
) -> str:
    """The head, then a row per sample: what `first` gives, three readings, more cells."""
    rows = [
        mark.join([*([str(t)] if t is not None else []), *(f"{v:.{digits}f}" for v in a)]) + more
        for t, a in zip(first, readings)
    ]
    return "\n".join([*head, *rows]) + "\n"


def seconds(unit_s: float = 1.0, digits: int = 3) -> list[str]:
    return [f"{t / unit_s:.{digits}f}" for t in T_S]


def stamps(form: str, digits: int = 3) -> list[str]:
    moments = [START + timedelta(seconds=float(t)) for t in T_S]
    return [f"{m.strftime(form)}.{m.microsecond:06d}"[: digits - 6 or None] for m in moments]


def phyphox() -> str:
    names = [f'"Acceleration {a} (m/s^2)"' for a in "xyz"]
    head = ",".join(['"Time (s)"', *names, '"Absolute acceleration (m/s^2)"'])
    return lines([head], (f"{t:.9E}" for t in T_S), G * A_G, more=",9.8")


def phyphox_decimal_commas() -> str:
    names = [f'"Acceleration {a} (m/s^2)"' for a in "xyz"]
    return lines([";".join(['"Time (s)"', *names])], seconds(), G * A_G, ";").replace(".", ",")


def gcdc() -> str:
    """Counts of 1/2048 g; comment lines; the header is a comment; the last line is one, too."""
    head = [
        ";Title, http://www.gcdataconcepts.com, x16-1d, ADXL345",
        ";Version, 1110, Build date, Dec 30 2015, SN:CCDC4016131F31B",
        ";Start_time, 2016-01-04, 10:25:14.000",
        ";Temperature, -999.00, deg C, Vbat, 1444, mv",
        ";SampleRate, 100,Hz",
        ";Deadband, 0, counts",
        ";DeadbandTimeout, 0,sec",
        ";Headers, time,Ax,Ay,Az",
    ]
    return lines(head, seconds(), 2048 * A_G, digits=0) + ";shutdown: switched off\n"


def xio() -> str:
    names = [f"Gyroscope {a} (deg/s)" for a in "XYZ"] + [f"Accelerometer {a} (g)" for a in "XYZ"]
    head = ",".join(["Timestamp (us)", *names])
    return lines([head], [f"{1e6 * t + 5e9:.0f},0.1,0.2,-0.3" for t in T_S])


def metawear() -> str:
    head = "epoch (ms),time (01:00),elapsed (s),x-axis (g),y-axis (g),z-axis (g)"
    iso = stamps("%Y-%m-%dT%H:%M:%S")
    first = [f"{1547219546110 + 1000 * t:.0f},{s},{t:.3f}" for t, s in zip(T_S, iso)]
    return lines([head], first)


def shimmer() -> str:
    """A line for Excel, a line of units, and a separator at the end of each row."""
    names = ["Timestamp_Unix_CAL", *(f"Accel_WR_{a}_CAL" for a in "XYZ"), "Gyro_X_CAL"]
    head = [
        '"sep=\t"',
        "".join(f"S_Seat_{name}\t" for name in names),
        "ms\tm/(s^2)\tm/(s^2)\tm/(s^2)\tdeg/s\t",
    ]
    return lines(head, [f"{1e3 * t + 1.7e12:.3f}" for t in T_S], G * A_G, "\t", "\t0.5\t")


def picoquake() -> str:
    head = [
        "# PLab PicoQuake Data",
        "# Time: 2024-04-21 15:54:46.333682, Device: D4E9 (E6632891E36F2029)",
        "# Num. samples: 300, Duration: 3.0 s",
        "# Config: data_rate = 100.0 Hz, filter = 488 Hz, acc_range = 4 g, gyro_range = 250.0 dps",
        "# Integrity: True, Skipped samples: 0",
        "count,a_x,a_y,a_z,g_x,g_y,g_z",
    ]
    return lines(head, range(1, 301), more=",1.5,2.5,-3.5")


def xsens() -> str:
    """Tabs, a counter of 16 bits that turns over, and columns without values."""
    head = [
        "// General information: ",
        "//  MT Manager version: 2022.2.0 ",
        "// Update Rate: 100.0Hz",
        "PacketCounter\tSampleTimeFine\tYear\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z",
    ]
    first = [f"{(65400 + i) % 65536}\tNaN\tNaN" for i in range(300)]
    return lines(head, first, G * A_G, "\t", "\t0.001960\t-0.000371\t0.005926")


def lvm() -> str:
    """LabVIEW: two headers, decimal commas, and a last column without cells."""
    head = [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t,",
        "X_Columns\tOne", "Date\t2019/07/22", "Time\t17:18:18,938945770263671875",
        "***End_of_Header***\t", "\t", "Channels\t3\t\t\t", "Samples\t300\t300\t300\t",
        "Date\t2019/07/22\t2019/07/22\t2019/07/22\t",
        "Time\t17:18:18,93\t17:18:18,93\t17:18:18,93\t", "Y_Unit_Label\tg\tg\tg\t",
        "X_Dimension\tTime\tTime\tTime\t", "X0\t0,0E+0\t0,0E+0\t0,0E+0\t",
        "Delta_X\t0,010000\t0,010000\t0,010000\t", "***End_of_Header***\t\t\t\t",
        "X_Value\tx\ty\tz\tComment",
    ]  # fmt: skip
    rows = lines([], seconds(digits=6), A_G, "\t").replace(".", ",")
    return "\n".join(head) + "\n" + rows


def picoscope() -> str:
    """Names, then units in brackets, then a blank line; milliseconds and millivolts."""
    head = ["Time;Channel X;Channel Y;Channel Z", "(ms);(mV);(mV);(mV)", ""]
    return lines(head, seconds(1e-3), 100 * A_G, ";", digits=8).replace(".", ",")


def hobo() -> str:
    """Dates with the month first, AM and PM over midnight, units after a comma, rows of events."""
    sn = "(LGR S/N: 2039067, SEN S/N: 2039067)"
    names = ",".join(f'"{a} Accel, g {sn}"' for a in "XYZ")
    head = ['"Plot Title: arm"', f'"#","Date Time, GMT+00:00",{names},"Started (LGR)"']
    at = [START + timedelta(seconds=float(t)) for t in T_S]
    first = [
        f"{i},{m.strftime('%m/%d/%y %I:%M:%S')}.{m.microsecond // 1000:03d} {m.strftime('%p')}"
        for i, m in enumerate(at, 2)
    ]
    event = "1,03/09/24 11:59:57.990 PM,,,,Logged"
    return lines([*head, event], first, more=",")


def actigraph() -> str:
    head = [
        "------------ Data File Created By ActiGraph GT3X+ ActiLife v6.13.3 Firmware v2.5.0 date "
        "format M/d/yyyy at 100 Hz  Filter Normal -----------",
        "Serial Number: CLE2B2013",
        "Start Time 23:59:58",
        "Start Date 3/9/2024",
        "Epoch Period (hh:mm:ss) 00:00:00",
        "--------------------------------------------------",
        "Accelerometer X,Accelerometer Y,Accelerometer Z",
    ]
    return lines(head, [None] * 300)


def axivity() -> str:
    """No header at all."""
    return lines([], stamps("%Y-%m-%d %H:%M:%S"))


def date_and_time() -> str:
    """German: date and time in two columns, with the day first."""
    head = ["Messung;Rührer 3", "Abtastrate [Hz];100", "Datum;Uhrzeit;Acc X [mg];Acc Y [mg];"
            "Acc Z [mg]"]  # fmt: skip
    first = [s.replace(" ", ";") for s in stamps("%d.%m.%Y %H:%M:%S")]
    return lines(head, first, 1000 * A_G, ";")


def spaces() -> str:
    head = ["% rate 100 Hz", "% t [s]    ax [g]    ay [g]    az [g]"]
    return lines(head, seconds(), mark="    ")


def endaq() -> str:
    """The bracket holds the range, which is no unit."""
    return lines(['"Time (s)","X (16g)","Y (16g)","Z (16g)"'], seconds(digits=6))


def telerig_units() -> str:
    return lines(["time_s,ax_g,ay_g,az_g"], seconds())


FILES: dict[str, tuple[Callable[[], str], dict[str, Any]]] = {
    "phyphox": (phyphox, {}),
    "phyphox with decimal commas": (phyphox_decimal_commas, {}),
    "Gulf Coast Data Concepts": (gcdc, {"scale_m_s2": G / 2048}),
    "x-io": (xio, {}),
    "MetaWear": (metawear, {}),
    "Shimmer": (shimmer, {}),
    "PicoQuake": (picoquake, {"unit": "g"}),
    "Xsens": (xsens, {"unit": "m/s2"}),
    "LabVIEW": (lvm, {"unit": "g"}),
    "PicoScope": (picoscope, {"scale_m_s2": G / 100}),
    "HOBO": (hobo, {}),
    "ActiGraph": (actigraph, {"unit": "g"}),
    "Axivity": (axivity, {"unit": "g", "channels": (1, 2, 3)}),
    "date and time": (date_and_time, {}),
    "spaces": (spaces, {}),
    "enDAQ": (endaq, {"unit": "g"}),
    "unit in the names": (telerig_units, {}),
}
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1")


def write(folder: Path, text: str, encoding: str = "utf-8", name: str = "logger.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def check(path: Path, **layout: Any) -> None:
    table = read_accelerations(path, "arm", Layout(**layout))
    assert len(table) == len(T_S)
    t_s = table["t_s"].to_numpy()
    np.testing.assert_allclose(t_s - t_s[0], T_S, rtol=0, atol=2e-6)
    found = table[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy()
    atol = 0.6 * G / 2048 if layout.get("scale_m_s2") == G / 2048 else 2e-5
    np.testing.assert_allclose(found, G * A_G, rtol=0, atol=atol)


@pytest.mark.parametrize("maker", FILES)
def test_files_of_makers_are_understood(maker: str, tmp_path: Path) -> None:
    make, layout = FILES[maker]
    check(write(tmp_path, make()), **layout)
    check(write(tmp_path, make().replace("\n", "\r\n")), **layout)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings(encoding: str, tmp_path: Path) -> None:
    check(write(tmp_path, date_and_time(), encoding))


@pytest.mark.parametrize("maker", [m for m, (_, layout) in FILES.items() if layout])
def test_a_unit_that_is_not_stated_is_asked_for_by_its_option(maker: str, tmp_path: Path) -> None:
    make, layout = FILES[maker]
    rest = {key: value for key, value in layout.items() if key == "channels"}
    with pytest.raises(InputError, match=r"unit[\s\S]*--unit g"):
        read_accelerations(write(tmp_path, make()), "arm", Layout(**rest))


def test_notes_say_how_a_file_was_understood(tmp_path: Path) -> None:
    notes = import_accelerations(write(tmp_path, hobo()), "arm").notes
    assert "1 rows are left out, because they have no reading" in notes
    assert any(
        "first time stamp of 'Date Time, GMT+00:00', 03/09/24 11:59:57.990 PM" in n for n in notes
    )
    notes = import_accelerations(write(tmp_path, xsens()), "arm", Layout(unit="m/s2")).notes
    assert "line 3 states a sampling rate of 100 Hz" in notes
    assert "times follow from the counter 'PacketCounter' at 100 Hz" in notes
    cut = write(tmp_path, phyphox() + "3.0,0.1")
    assert any("row 302 is left out" in n for n in import_accelerations(cut, "arm").notes)


def test_samples_that_a_counter_misses_leave_a_gap(tmp_path: Path) -> None:
    rows = xsens().splitlines()
    path = write(tmp_path, "\n".join(rows[:104] + rows[114:]) + "\n")
    found = import_accelerations(path, "arm", Layout(unit="m/s2"))
    assert "the counter 'PacketCounter' shows that 10 samples are missing" in found.notes
    assert np.max(np.diff(found.table["t_s"])) == pytest.approx(0.11)


@pytest.mark.parametrize("unit_s", [1e-3, 1e-6, 1e-9])
def test_the_unit_of_times_follows_from_a_stated_rate_or_is_asked_for(
    unit_s: float, tmp_path: Path
) -> None:
    first = [f"{t / unit_s:.0f}" for t in T_S]
    check(write(tmp_path, lines(["Sampling rate: 0.1 kHz", "time,ax_g,ay_g,az_g"], first)))
    silent = write(tmp_path, lines(["time,ax_g,ay_g,az_g"], first))
    with pytest.raises(InputError, match=r"unit of the times in 'time'[\s\S]*--time-unit ms"):
        read_accelerations(silent, "arm")
    tenths = write(tmp_path, lines(["time,ax_g,ay_g,az_g"], seconds(0.1)), name="tenths.csv")
    with pytest.raises(InputError, match=r"increase by 0\.1"):
        read_accelerations(tenths, "arm")
    check(silent, time_unit={1e-3: "ms", 1e-6: "us", 1e-9: "ns"}[unit_s])


@pytest.mark.parametrize("unit_s", [1.0, 1e-3, 1e-6])
def test_times_since_1970_say_their_unit(unit_s: float, tmp_path: Path) -> None:
    first = [f"{(1.7e9 + t) / unit_s:.{3 if unit_s == 1 else 0}f}" for t in T_S]
    check(write(tmp_path, lines(["timestamp,ax_g,ay_g,az_g"], first)))


@pytest.mark.parametrize(
    "stated",
    [
        "Sampling rate (kHz): 0.1", "Sampling rate: 0.1 kS/s", "Sample rate: 0.1 kSps",
        "Sample rate: 100 samples/s", "Sampling frequency: 0.0001 MHz", "sample_rate_hz: 100",
        '"Sample rate","100","Hz"', "Sampling rate: 0,1 kHz", "fs = 100 Hz",
        "Sampling interval (ms): 10", "Sampling interval: 10 milliseconds",
        "Sample interval [us]: 10000", "Sampling period: 10000 µs", "Sampling interval: 0.01",
        "LIS2DW12, FS = 16 g, ODR = 100 Hz", "Low-pass filter at 40 Hz, sample rate 100 Hz",
        "ODR 100 Hz, sampling interval 10 ms",
        "Sampled at 100 Hz, low-pass filter at 40 Hz",
    ],
)  # fmt: skip
def test_a_stated_rate_or_interval_has_the_unit_that_is_written(
    stated: str, tmp_path: Path
) -> None:
    check(write(tmp_path, lines([f"# {stated}", "x (g),y (g),z (g)"], [None] * 300)))
    milliseconds = [f"{1e3 * t:.3f}" for t in T_S]
    check(write(tmp_path, lines([f"# {stated}", "time,x (g),y (g),z (g)"], milliseconds)))


@pytest.mark.parametrize(
    "stated",
    [
        "Sampling rate: 1,600 Hz", "Sampling rate 10 240 Hz", "Low-pass filter at 40 Hz",
        "LIS2DW12, FS = 16 g", "fs: 100", "Oversampling rate: 16", "Data rate: 921600 baud",
        "Sampling interval: 625 ticks", "Sampling rate: 1/1600 s",
    ],
)  # fmt: skip
def test_a_rate_that_can_be_doubted_is_asked_for(stated: str, tmp_path: Path) -> None:
    path = write(tmp_path, lines([f"# {stated}", "x (g),y (g),z (g)"], [None] * 300))
    with pytest.raises(InputError, match=r"neither times nor a sampling rate[\s\S]*--rate-hz"):
        read_accelerations(path, "arm")


@pytest.mark.parametrize(
    ("name", "unit_s"),
    [("time_min", 60), ("Time min", 60), ("time_h", 3600), ("Time (h)", 3600)],
)
def test_times_in_minutes_and_hours(name: str, unit_s: float, tmp_path: Path) -> None:
    check(write(tmp_path, lines([f"{name},x (g),y (g),z (g)"], seconds(unit_s, 12))))


@pytest.mark.parametrize("unit", ["m·s⁻²", "m s⁻²", "ms⁻²", "m.s-2"])
def test_units_with_a_negative_exponent(unit: str, tmp_path: Path) -> None:
    head = ",".join(["Time (s)", *(f"{axis} ({unit})" for axis in "xyz")])
    check(write(tmp_path, lines([head], seconds(), G * A_G)))


def test_decimal_commas_in_quotes(tmp_path: Path) -> None:
    rows = lines([], seconds(), mark=";").replace(".", ",").splitlines()
    quoted = [",".join(f'"{cell}"' for cell in row.split(";")) for row in rows]
    check(write(tmp_path, "\n".join(["Time (s),X (g),Y (g),Z (g)", *quoted])))


def test_separators_of_thousands_are_not_decimal_commas(tmp_path: Path) -> None:
    whole = np.array([[3, -5, 999], [3, -5, 1000], [3, -5, 1002]])
    for head, mark in (("Time (ms)\tX (mg)\tY (mg)\tZ (mg)", "\t"), ("t_ms;x_mg;y_mg;z_mg", ";")):
        rows = [mark.join([str(i), *(f"{v:,}" for v in row)]) for i, row in enumerate(whole)]
        path = write(tmp_path, "\n".join([head, *rows]))
        column = head.split(mark)[3]
        with pytest.raises(InputError) as error:
            read_accelerations(path, "arm")
        words = f"row 3: the column {column!r} does not tell whether '1,000' is 1000 or 1.000"
        assert words in str(error.value)
    quoted = [f'"{10 * i:,}",0.1,0.2,0.9' for i in range(300)]
    path = write(tmp_path, "\n".join(["Time (ms),X (g),Y (g),Z (g)", *quoted]))
    with pytest.raises(InputError, match=r"row 102: the column 'Time \(ms\)'"):
        read_accelerations(path, "arm")
    metres = [f"0,{i:03d};0,100;-0,200;9,806" for i in range(10)]
    path = write(tmp_path, "\n".join(["Time (s);X (m/s2);Y (m/s2);Z (m/s2)", *metres]))
    assert read_accelerations(path, "arm")["az_m_s2"].tolist() == [9.806] * 10


@pytest.mark.parametrize("first", [seconds(), stamps("%Y-%m-%d %H:%M:%S")])
def test_blank_rows_and_a_blank_last_column(first: list[str], tmp_path: Path) -> None:
    head = "Time,X (g),Y (g),Z (g)"
    rows = lines([head], first).splitlines()
    check(write(tmp_path, "\n".join([*rows, *[",,,"] * 400])))
    check(write(tmp_path, "\n".join([*rows[:50], ",,,", *rows[50:]])))
    check(write(tmp_path, lines([head], first, more=",")))


def test_a_labview_file_without_a_column_of_times(tmp_path: Path) -> None:
    end = "***End_of_Header***\t\t\t\t"
    head = [
        "LabVIEW Measurement\t", "X_Columns\tNo", end, "Channels\t3\t\t\t",
        "Samples\t300\t300\t300\t", "Delta_X\t0.01\t0.01\t0.01\t", end,
        "X_Value\tX (g)\tY (g)\tZ (g)\tComment",
    ]  # fmt: skip
    check(write(tmp_path, lines(head, [""] * 300, mark="\t"), name="a.lvm"))
    no_step = [line for line in head if "Delta_X" not in line]
    with pytest.raises(InputError, match=r"neither times nor a sampling rate[\s\S]*--rate-hz"):
        read_accelerations(write(tmp_path, lines(no_step, [""] * 300, mark="\t")), "arm")


def test_what_cannot_be_told_is_asked_for(tmp_path: Path) -> None:
    two = lines(
        ["t_s,LN_X (g),LN_Y (g),LN_Z (g),WR_X (g),WR_Y (g),WR_Z (g)"], seconds(), more=",1,2,3"
    )
    with pytest.raises(InputError, match=r"2 sets of channels[\s\S]*--channels LN_X \(g\),"):
        read_accelerations(write(tmp_path, two), "arm")
    same = lines(["t_s,X (g),Y (g),Z (g),X (g),Y (g),Z (g)"], seconds(), more=",1,2,3")
    with pytest.raises(InputError, match=r"--channels"):
        read_accelerations(write(tmp_path, same), "arm")
    check(write(tmp_path, same), channels=(1, 2, 3), unit="g")
    no_times = lines(["x (g),y (g),z (g)"], [None] * 300)
    with pytest.raises(InputError, match=r"neither times nor a sampling rate[\s\S]*--rate-hz"):
        read_accelerations(write(tmp_path, no_times), "arm")
    check(write(tmp_path, no_times), rate_hz=RATE_HZ)
    rounded = lines(["Time (s),X (g),Y (g),Z (g)"], seconds(digits=1))
    with pytest.raises(InputError, match=r"row 3[\s\S]*times must increase[\s\S]*--rate-hz"):
        read_accelerations(write(tmp_path, rounded), "arm")
    with pytest.raises(InputError, match="--time-unit weeks: there is no such unit"):
        read_accelerations(write(tmp_path, rounded), "arm", Layout(time_unit="weeks"))


def test_damage_is_named_by_its_row(tmp_path: Path) -> None:
    rows = phyphox().splitlines()
    for damage, words in (
        ("1,2,3", "row 51: '1,2,3' has 3 cells, most rows have 5"),
        ("4.9E-1,1,OVERFLOW,3,9", "row 51: reading 49 of 'Acceleration y (m/s^2)' is 'OVERFLOW'"),
        ("4.9E-1,1,,3,9", "row 51: reading 49 of 'Acceleration y (m/s^2)' is no finite number"),
        ("4.8E-1,1,2,3,9", "row 51: time 0.48 s follows 0.48 s"),
    ):
        path = write(tmp_path, "\n".join([*rows[:50], damage, *rows[51:]]))
        with pytest.raises(InputError) as error:
            read_accelerations(path, "arm")
        assert words in str(error.value)
    mixed = write(tmp_path, phyphox_decimal_commas().replace(",1", ".1"))
    with pytest.raises(InputError, match="decimal commas and numbers with decimal points"):
        read_accelerations(mixed, "arm")
    for nothing in (b"", b"\n\n", b"a,b\nc,d\n", b"\x89PNG\0\0\1", b"\xff\xfe\0"):
        path.write_bytes(nothing)
        with pytest.raises(InputError, match=r"logger\.csv"):
            read_accelerations(path, "arm")
