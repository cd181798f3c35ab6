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
    "x-io": (xio, {}),
    "MetaWear": (metawear, {}),
    "unit in the names": (telerig_units, {}),
    "spaces": (spaces, {}),
    "enDAQ": (endaq, {"unit": "g"}),
    "LabVIEW": (lvm, {"columns": (0, 1, 2, 3), "unit": "g", "time_unit": "s"}),
    "ActiGraph": (actigraph, {"unit": "g", "rate_hz": RATE_HZ}),
    "Gulf Coast Data Concepts": (
        gcdc, {"columns": (0, 1, 2, 3), "time_unit": "s", "scale_m_s2": G / 2048},
    ),
    "Shimmer": (shimmer, {"columns": (0, 1, 2, 3), "time_unit": "ms", "unit": "m/s^2"}),
    "PicoQuake": (picoquake, {"columns": ("count", "a_x", "a_y", "a_z"), "unit": "g",
                              "rate_hz": RATE_HZ}),
    "Xsens": (xsens, {"columns": ("PacketCounter", "Acc_X", "Acc_Y", "Acc_Z"), "unit": "m/s2",
                      "rate_hz": RATE_HZ}),
    "PicoScope": (picoscope, {"columns": ("Time", "Channel X", "Channel Y", "Channel Z"),
                              "time_unit": "ms", "scale_m_s2": G / 100}),
    "HOBO": (hobo, {"columns": (1, 2, 3, 4), "time_unit": "%m/%d/%y %I:%M:%S.%f %p", "unit": "g"}),
    "Axivity": (axivity, {"columns": (0, 1, 2, 3), "time_unit": "%Y-%m-%d %H:%M:%S.%f",
                          "unit": "g"}),
    "date and time": (date_and_time, {"rate_hz": RATE_HZ}),
}  # fmt: skip
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "latin-1")


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
def test_files_of_makers_are_read(maker: str, tmp_path: Path) -> None:
    make, layout = FILES[maker]
    check(write(tmp_path, make()), **layout)
    check(write(tmp_path, make().replace("\n", "\r\n")), **layout)


@pytest.mark.parametrize("maker", [maker for maker, (_, layout) in FILES.items() if layout])
def test_what_a_file_does_not_say_is_asked_for_by_an_option(maker: str, tmp_path: Path) -> None:
    """Without one of its options a file is refused, and the error names this option."""
    make, layout = FILES[maker]
    options = {"unit": "--unit", "scale_m_s2": "--scale", "rate_hz": "--rate-hz",
               "time_unit": "--time-unit", "columns": "--columns"}  # fmt: skip
    for left_out in layout:
        rest = {key: value for key, value in layout.items() if key != left_out}
        if maker == "HOBO" and left_out == "unit":
            continue  # its header has it
        if maker in ("PicoQuake", "Xsens") and left_out == "columns":
            check(write(tmp_path, make()), **rest)  # known names of the axes, no counter
            continue
        with pytest.raises(InputError) as error:
            read_accelerations(write(tmp_path, make()), "arm", Layout(**rest))
        wanted = {options[left_out]} | ({"--time-unit"} if left_out == "rate_hz" else set())
        assert any(option in str(error.value) for option in wanted)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings(encoding: str, tmp_path: Path) -> None:
    make, layout = FILES["date and time"]
    check(write(tmp_path, make(), encoding), **layout)


def test_real_recordings_of_an_endaq_sensor(tmp_path: Path) -> None:
    """The names are those of its export: time_s, ax_g, ay_g, az_g."""
    rows = ["0.952392,0.01069,-0.01385,0.92759", "0.954929,0.01462,-0.01775,0.99084"]
    path = write(tmp_path, "\n".join(["time_s,ax_g,ay_g,az_g", *rows]))
    found = read_accelerations(path, "arm")
    assert found["t_s"].tolist() == [0.952392, 0.954929]
    assert found["az_m_s2"].tolist() == [0.92759 * G, 0.99084 * G]
    with pytest.raises(InputError, match="--columns"):
        read_accelerations(write(tmp_path, "time_s,qx,qy,qz,qw\n1,0,0,0,1\n"), "arm")


def test_samples_that_a_counter_misses_leave_a_gap(tmp_path: Path) -> None:
    rows = xsens().splitlines()
    path = write(tmp_path, "\n".join(rows[:104] + rows[114:]) + "\n")
    found = import_accelerations(path, "arm", Layout(**FILES["Xsens"][1]))
    assert "times follow from the counter 'PacketCounter' at 100 Hz" in found.notes
    assert np.max(np.diff(found.table["t_s"])) == pytest.approx(0.11)
    layout = FILES["Xsens"][1] | {"columns": ("Gyr_X", "Acc_X", "Acc_Y", "Acc_Z")}
    with pytest.raises(InputError, match="does not count the samples"):
        read_accelerations(write(tmp_path, xsens()), "arm", Layout(**layout))


@pytest.mark.parametrize(
    ("name", "unit_s"),
    [("time_min", 60), ("Time (ms)", 1e-3), ("t_us", 1e-6), ("elapsed (h)", 3600)],
)
def test_units_of_times(name: str, unit_s: float, tmp_path: Path) -> None:
    check(write(tmp_path, lines([f"{name},x (g),y (g),z (g)"], seconds(unit_s, 12))))


@pytest.mark.parametrize("unit", ["m/s^2", "m/s2", "m·s⁻²", "m s⁻²", "m.s-2", "m/(s^2)", "m/s/s"])
def test_spellings_of_metres_per_second_squared(unit: str, tmp_path: Path) -> None:
    head = ",".join(["Time (s)", *(f"{axis} ({unit})" for axis in "xyz")])
    check(write(tmp_path, lines([head], seconds(), G * A_G)))


def test_rows_without_a_reading_are_left_out(tmp_path: Path) -> None:
    rows = lines(["Time (s),X (g),Y (g),Z (g)"], seconds()).splitlines()
    check(write(tmp_path, "\n".join([*rows[:50], ",,,", *rows[50:], *[",,,"] * 400])))
    check(write(tmp_path, lines(rows[:1], seconds(), more=",")))
    event = write(tmp_path, "\n".join([*rows[:50], "0.485,,,", *rows[50:]]))
    notes = import_accelerations(event, "arm").notes
    assert "left out: 1 row without a reading" in notes
    cut = write(tmp_path, phyphox() + "3.0,0.1")
    assert any("row 302 is left out" in n for n in import_accelerations(cut, "arm").notes)


def test_separators_of_thousands_are_not_decimal_commas(tmp_path: Path) -> None:
    whole = np.array([[3, -5, 999], [3, -5, 1000], [3, -5, 1002]])
    for head, mark in (("Time (ms)\tX (mg)\tY (mg)\tZ (mg)", "\t"), ("t_ms;x_mg;y_mg;z_mg", ";")):
        rows = [mark.join([str(i), *(f"{v:,}" for v in row)]) for i, row in enumerate(whole)]
        with pytest.raises(InputError, match=r"row 3: the column .* '1,000' is 1000 or 1\.000"):
            read_accelerations(write(tmp_path, "\n".join([head, *rows])), "arm")
    metres = [f"0,{i:03d};0,100;-0,200;9,806" for i in range(10)]
    path = write(tmp_path, "\n".join(["Time (s);X (m/s2);Y (m/s2);Z (m/s2)", *metres]))
    assert read_accelerations(path, "arm")["az_m_s2"].tolist() == [9.806] * 10


def test_names_that_stand_twice_are_asked_about(tmp_path: Path) -> None:
    same = lines(["t_s,X (g),Y (g),Z (g),X (g),Y (g),Z (g)"], seconds(), more=",1,2,3")
    with pytest.raises(InputError, match="--columns"):
        read_accelerations(write(tmp_path, same), "arm")
    check(write(tmp_path, same), columns=(0, 1, 2, 3), unit="g", time_unit="s")


def test_damage_is_named_by_its_row(tmp_path: Path) -> None:
    rows = phyphox().splitlines()
    for damage, words in (
        ("1,2,3", "row 51: has 3 cells, the rows above have 5"),
        ("4.9E-1,1,OVERFLOW,3,9", "row 51: reading 49 of 'Acceleration y (m/s^2)' is 'OVERFLOW'"),
        ("4.9E-1,1,,3,9", "row 51: reading 49 of 'Acceleration y (m/s^2)' is no finite number"),
        ("4.8E-1,1,2,3,9", "row 51: time 0.48 s follows 0.48 s"),
    ):
        path = write(tmp_path, "\n".join([*rows[:50], damage, *rows[51:]]))
        with pytest.raises(InputError) as error:
            read_accelerations(path, "arm")
        assert words in str(error.value)
    rounded = lines(["Time (s),X (g),Y (g),Z (g)"], seconds(digits=1))
    with pytest.raises(InputError, match=r"row 3[\s\S]*times must increase[\s\S]*--rate-hz"):
        read_accelerations(write(tmp_path, rounded), "arm")
    for nothing in (b"", b"\n\n", b"a,b\nc,d\n", b"\x89PNG\0\0\1", b"\xff\xfe\0"):
        path.write_bytes(nothing)
        with pytest.raises(InputError, match=r"logger\.csv"):
            read_accelerations(path, "arm")
