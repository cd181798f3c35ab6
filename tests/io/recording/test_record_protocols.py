"""What the bytes of a serial line say, in whatever pieces and with whatever garbage they come."""

from __future__ import annotations

import struct
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from telerig.io.recording.protocols import (
    Parser,
    Readings,
    joined,
    parser,
    poll_command,
    xor_checksum,
)
from telerig.io.rig_file.description import DeviceDescription

ENCODER = DeviceDescription("encoder", "encoder", "x", counts_per_mm=1.0)
ACCELEROMETER = DeviceDescription("arm", "accelerometer", "x")
PACKETS = replace(ACCELEROMETER, protocol="packets")


def fed(parser: Parser, data: bytes, cuts: list[int], together: int = 1) -> Readings:
    """Feed ``data`` cut at places, the k-th piece at time k; so many pieces at a time."""
    edges = [0, *sorted(cuts), len(data)]
    pieces = [(k, data[a:b]) for k, (a, b) in enumerate(pairwise(edges))]
    groups = [pieces[i : i + together] for i in range(0, len(pieces), together)]
    return joined([parser.feed(group) for group in groups])


def packet(t: int, *axes: int) -> bytes:
    body = b"\xa5\x5a" + struct.pack("<Ihhh", t, *axes)
    return body + bytes([sum(body) % 256])


def test_lines_of_an_encoder() -> None:
    found = parser(ENCODER).feed([(7, b"10,-5\r\n20,6,ok\n30,+7\n")])
    assert found.values["t"].tolist() == [10, 20, 30]
    assert found.values["counts"].tolist() == [-5, 6, 7]
    assert found.arrived_ns.tolist() == [7, 7, 7]
    assert len(found.malformed) == 0


@pytest.mark.parametrize("together", [1, 3, 1000])
@pytest.mark.parametrize("device", [ENCODER, PACKETS], ids=["lines", "packets"])
def test_any_cutting_gives_the_same_readings_at_the_time_of_their_last_byte(
    device: DeviceDescription, together: int
) -> None:
    rng = np.random.default_rng(0)
    lines = device is ENCODER
    pieces = [
        f"{1000 * k},{k * k}\r\n".encode() if lines else packet(1000 * k, k, -k, 165)
        for k in range(60)
    ]
    data, ends = b"".join(pieces), np.cumsum([len(p) for p in pieces])
    for _ in range(20):
        cuts = np.unique(rng.integers(1, len(data), 45)).tolist()
        found = fed(parser(device), data, cuts, together)
        assert found.values["t"].tolist() == [1000 * k for k in range(60)]
        assert found.arrived_ns.tolist() == np.searchsorted(cuts, ends - 1, "right").tolist()
        assert len(found.malformed) == 0


def test_the_rest_of_a_line_at_the_begin_is_not_malformed() -> None:
    reader = parser(ENCODER)
    assert len(reader.feed([(0, b"3,17\n10,5\n")]).values["t"]) == 2, "a rest that reads is kept"
    reader = parser(ENCODER)
    found = reader.feed([(0, b",17\n10,5\n2")])
    assert found.values["t"].tolist() == [10] and len(found.malformed) == 0
    assert reader.cut() == 1
    assert reader.feed([(0, b"0\n30,5\n")]).values["t"].tolist() == [30]


def test_garbage_is_counted_and_the_next_line_read() -> None:
    data = b"10,1\n\x00\xff\xfe,,\n20,x2\n\n30,3\n40\n50,5\n"
    found = parser(ENCODER).feed([(0, data)])
    assert found.values["t"].tolist() == [10, 30, 50]
    assert len(found.malformed) == 3
    assert found.malformed_bytes == len(b"\x00\xff\xfe,,") + len(b"20,x2") + len(b"40")
    assert found.samples[1] == b"20,x2"


def test_no_line_end_for_ever_does_not_fill_the_memory() -> None:
    reader = parser(ENCODER)
    reader.feed([(0, b"1,1\n")])
    bad = sum(len(reader.feed([(k, b"\x80" * 1000)]).malformed) for k in range(100))
    assert bad >= 15
    assert reader.cut() <= 5000


def test_a_checksum_refuses_what_reads_like_a_line() -> None:
    reader = parser(replace(ENCODER, checksum="xor"))
    good = b"12,34"
    assert xor_checksum(good) == b"*%02X" % (0x31 ^ 0x32 ^ 0x2C ^ 0x33 ^ 0x34)
    data = good + xor_checksum(good) + b"\r\n"
    found = reader.feed([(0, data + data.replace(b"34", b"35") + b"12,34\n" + data)])
    assert found.values["counts"].tolist() == [34, 34]
    assert len(found.malformed) == 2


def test_accelerometer_numbers() -> None:
    found = parser(ACCELEROMETER).feed([(0, b"5,-1.25,+9.8,.5\n6,1e-3,2.,3\n7,nan,1,2\n")])
    assert found.values["ax"].tolist() == [-1.25, 0.001]
    assert found.values["az"].tolist() == [0.5, 3.0]
    assert len(found.malformed) == 1


def test_zaber_and_grbl_answers() -> None:
    zaber = replace(ENCODER, protocol="zaber")
    assert poll_command(zaber) == b"/1 get pos\n"
    found = parser(zaber).feed(
        [(0, b"@01 0 OK IDLE -- -1200\r\n@01 0 RJ IDLE -- BADCOMMAND\r\n@01 1 OK BUSY WR 7:8F\r\n")]
    )
    assert found.values["counts"].tolist() == [-1200, 7]
    assert len(found.malformed) == 1
    grbl = replace(ENCODER, protocol="grbl", axis="y")
    assert poll_command(grbl) == b"?"
    told = (
        b"<Idle|MPos:1.000,-2.500,3.000|FS:0,0>\r\nok\r\n<Hold:0|Pn:X|MPos:0.000,4.000,0.000>\r\n"
    )
    found = parser(grbl).feed([(0, told)])
    assert found.values["position_mm"].tolist() == [-2.5, 4.0]


def test_an_expression_of_ones_own() -> None:
    own = replace(ENCODER, protocol="regex", pattern=r"T=(?P<t>\d+)ms P=(?P<position_mm>\S+) mm")
    found = parser(own).feed([(0, b"T=5ms P=1.5 mm\nT=6ms P=-- mm\nT=7ms P=2 mm\n")])
    assert found.values["t"].tolist() == [5, 6, 7]
    assert np.array_equal(found.values["position_mm"], [1.5, np.nan, 2.0], equal_nan=True)


def test_packets_are_found_again_after_garbage() -> None:
    rng = np.random.default_rng(1)
    whole = [packet(k, k, 0xA5, -k) for k in range(200)]
    noise = rng.integers(0, 256, 37, np.uint8).tobytes() + b"\xa5\x5a\xa5"
    data = b"".join([*whole[:50], noise, *whole[50:100], whole[100][:5], *whole[101:]])
    found = fed(parser(PACKETS), data, list(range(13, len(data), 29)))
    kept = found.values["t"].astype(int).tolist()
    assert set(range(50)) <= set(kept) and set(range(102, 200)) <= set(kept)
    assert found.values["az"].tolist() == [-k for k in kept]
    assert found.malformed_bytes == len(data) - len(whole[0]) * len(kept)
