"""A thousand damaged logs of each format: read or refused, never a traceback, never a hang."""

from __future__ import annotations

import time

import numpy as np
import pytest
import test_gpx
import test_nmea
import test_rtklib
import test_ubx

from railnav.errors import RailnavError
from railnav.io.gnss_log import read_log

LOGS = {
    "nmea": (test_nmea.DATA, test_nmea.START),
    "rtklib-pos": (test_rtklib.DATA, test_rtklib.START),
    "ubx": (test_ubx.DATA, test_ubx.START),
    "gpx": (test_gpx.DATA, test_gpx.START),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LOGS)
def test_a_thousand_damaged_logs(tmp_path, name):
    data, start = LOGS[name]
    random = np.random.default_rng(17)
    path = tmp_path / "log"
    path.write_bytes(data)
    assert read_log(path, name, start=start).summary.fixes > 0  # and the parser is compiled
    read = 0
    for _ in range(1000):
        damaged = bytearray(data)
        for _ in range(random.integers(1, 12)):
            place = int(random.integers(len(damaged)))
            match random.integers(4):
                case 0:
                    damaged[place] = random.integers(256)
                case 1:
                    damaged[place : place + int(random.integers(200))] = b""
                case 2:
                    damaged[place:place] = random.bytes(int(random.integers(60)))
                case 3:
                    other = int(random.integers(len(damaged)))
                    damaged[place:place] = damaged[other : other + 100]
        path.write_bytes(damaged[: int(random.integers(len(damaged) // 2, len(damaged) + 1))])
        begin = time.perf_counter()
        try:
            log = read_log(path, name, start=start)
        except RailnavError as error:
            message = str(error)
        else:
            read += 1
            message = str(log.summary)
            assert (np.diff(log.table.number["time_s"]) > 0).all()
        assert time.perf_counter() - begin < 1.0
        assert "\n" not in message
    assert read < 1000
