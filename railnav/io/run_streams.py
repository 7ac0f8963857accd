"""Streams of a run: columns of a file in its units, turned into SI and radians, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, RunError
from railnav.io.run_contents import (
    CONTENTS,
    GaugeEntry,
    GnssEntry,
    ImuEntry,
    OdometerEntry,
    decimal_year,
    declared,
    epoch_of,
    inside_folder,
)
from railnav.io.tables import Column, Table, Words, freeze
from railnav.run import (
    BaliseStream,
    GaugeStream,
    GnssErrors,
    GnssStream,
    GyroAnglesStream,
    ImuErrors,
    ImuStream,
    OdometerErrors,
    OdometerStream,
    Run,
)

FloatArray = NDArray[np.float64]
#: An unsigned odometer may fall by its noise, m, not by more.
ODOMETER_NOISE = 0.1
#: Zero of the Celsius scale, K.
CELSIUS = 273.15


def _optional(*names: str, positive: bool = False) -> tuple[Column, ...]:
    return tuple(Column(name, required=False, complete=False, positive=positive) for name in names)


_TIME = Column("time_s")
_NO_FIX = "remove rows without a fix"
STREAM_COLUMNS: dict[str, tuple[Column, ...]] = {
    "gnss": (
        _TIME,
        Column("latitude_deg", low=-90, high=90, remedy=_NO_FIX),
        Column("longitude_deg", low=-180, high=180, remedy=_NO_FIX),
        *_optional("height_m", "speed_m_s", "course_deg", "quality", "satellites", "hdop"),
        *_optional("sigma_east_m", "sigma_north_m", "sigma_up_m", "sigma_speed_m_s", positive=True),
    ),
    "imu": (
        _TIME,
        *(Column(f"gyro_{axis}_rad_s") for axis in "xyz"),
        *(Column(f"accel_{axis}_m_s2") for axis in "xyz"),
        Column("temperature_c", required=False, complete=False, low=-100, high=200),
    ),
    "odometer": (_TIME, *_optional("distance_m", "speed_m_s"), *_optional("sigma_speed_m_s", positive=True)),
    "gyro_angles": (_TIME, Column("roll_deg"), Column("pitch_deg"), Column("heading_deg")),
    "gauge": (_TIME, Column("gauge_mm", low=100, high=5000), *_optional("cant_mm")),
    "balise": (_TIME, Column("id", text=True), *_optional("sigma_m", positive=True)),
}


def stamps(table: Table, offset: float) -> FloatArray:
    """Times of a stream with its offset, s, strictly increasing."""
    read = table.increasing("time_s")
    if offset == 0.0:
        return read
    shifted = freeze(read + offset)
    return replace(table, number={"time_s": shifted}).increasing("time_s")  # stamps so close that the sum merges them


def _known(table: Table, name: str) -> FloatArray | None:
    values = table.number.get(name)
    return None if values is None or np.isnan(values).all() else values


def _angle(table: Table, name: str) -> FloatArray | None:
    values = _known(table, name)
    return None if values is None else freeze(np.deg2rad(values))


def _fixed(values: Sequence[float]) -> FloatArray:
    return freeze(np.array(values, dtype=np.float64))


def gnss_stream(table: Table, time: FloatArray, stream: GnssEntry, start: datetime, toml: Path) -> GnssStream:
    """Fixes in WGS 84, turned there from the frame that run.toml names."""
    latitude, longitude = np.deg2rad(table.number["latitude_deg"]), np.deg2rad(table.number["longitude_deg"])
    height = _known(table, "height_m")
    epoch = None if stream.epoch is None else epoch_of(stream.epoch, toml)
    named = str(stream.frame)  # an EPSG code may stand as a number
    if stream.carried:
        if named != "WGS84" or not stream.fixed_to:
            cause = (
                "coordinates that are carried already stand in frame WGS84, with the fixed_to that they were carried to"
            )
            raise RunError(
                cause, file=toml, column="gnss.carried", remedy="leave carried out, and they are carried on reading"
            )
    elif named != "WGS84" or stream.fixed_to:
        from railnav.geodesy.transformation import geodetic_frame

        try:
            frame = geodetic_frame(
                named,
                latitude,
                longitude,
                epoch=decimal_year(start) if epoch is None else epoch,
                fixed_to=stream.fixed_to or None,
                plate=stream.plate or None,
            )
            latitude, longitude, up = frame.to_wgs84(latitude, longitude, height)
        except CrsError as error:
            raise RunError(str(error), file=toml, column="gnss.frame") from error
        height = None if height is None else freeze(up)
    return GnssStream(
        time=time,
        latitude=freeze(latitude),
        longitude=freeze(longitude),
        height=height,
        sigma_east=_known(table, "sigma_east_m"),
        sigma_north=_known(table, "sigma_north_m"),
        sigma_up=_known(table, "sigma_up_m"),
        speed=_known(table, "speed_m_s"),
        course=_angle(table, "course_deg"),
        sigma_speed=_known(table, "sigma_speed_m_s"),
        quality=_known(table, "quality"),
        satellites=_known(table, "satellites"),
        hdop=_known(table, "hdop"),
        lever_arm_b=_fixed(stream.lever_arm_m),
        frame=named,
        epoch=epoch,
        fixed_to=stream.fixed_to,
        receiver=stream.receiver,
        errors=declared(GnssErrors, stream.errors),
    )


def imu_stream(table: Table, time: FloatArray, stream: ImuEntry, folder: Path) -> ImuStream:
    """Inertial samples, corrected by the calibration that run.toml names."""
    temperature = _known(table, "temperature_c")
    imu = ImuStream(
        time=time,
        gyro=freeze(np.column_stack([table.number[f"gyro_{axis}_rad_s"] for axis in "xyz"])),
        specific_force=freeze(np.column_stack([table.number[f"accel_{axis}_m_s2"] for axis in "xyz"])),
        lever_arm_b=_fixed(stream.lever_arm_m),
        mounting=_fixed(np.deg2rad(stream.mounting_deg).tolist()),
        temperature=None if temperature is None else freeze(temperature + CELSIUS),
        errors=declared(ImuErrors, stream.errors),
    )
    if not stream.calibration:
        return imu
    from railnav.io.imu_calibration import calibrated_stream

    return calibrated_stream(imu, inside_folder(folder, stream.calibration, "imu.calibration"))


def odometer_stream(table: Table, time: FloatArray, stream: OdometerEntry) -> OdometerStream:
    """Odometer readings; an unsigned distance that falls is refused."""
    distance, speed = _known(table, "distance_m"), _known(table, "speed_m_s")
    if distance is None and speed is None:
        cause = "neither distance_m nor speed_m_s has values"
        raise RunError(cause, file=table.file, row=1, remedy="an odometer needs one of these columns")
    empty = np.ones(table.length, dtype=bool)
    for values in (distance, speed):
        if values is not None:
            empty &= np.isnan(values)
    if empty.any():
        column = "distance_m" if distance is not None else "speed_m_s"
        table.refuse(int(np.argmax(empty)), column, "is empty or not a number", "remove rows without a reading")
    if distance is not None and not stream.signed:
        known = np.flatnonzero(~np.isnan(distance))
        fallen = np.flatnonzero(np.diff(distance[known]) < -ODOMETER_NOISE)
        if len(fallen):
            before, now = known[fallen[0]], known[fallen[0] + 1]
            cause = f"cumulative distance falls from {distance[before]:.12g} to {distance[now]:.12g} m"
            table.refuse(
                int(now), "distance_m", cause, f"set signed = true under [odometer] in {CONTENTS}, or split the run"
            )
    errors = declared(OdometerErrors, stream.errors)
    return OdometerStream(time, distance, speed, _known(table, "sigma_speed_m_s"), stream.signed, errors)


def gyro_angles_stream(table: Table, time: FloatArray) -> GyroAnglesStream:
    """Attitude."""
    roll, pitch, heading = (freeze(np.deg2rad(table.number[f"{name}_deg"])) for name in ("roll", "pitch", "heading"))
    return GyroAnglesStream(time, roll, pitch, heading)


def gauge_stream(table: Table, time: FloatArray, stream: GaugeEntry) -> GaugeStream:
    """Gauge and cant."""
    cant = _known(table, "cant_mm")
    gauge = freeze(table.number["gauge_mm"] / 1000)
    return GaugeStream(time, gauge, None if cant is None else freeze(cant / 1000), stream.reference_rail)


def balise_stream(table: Table, time: FloatArray) -> BaliseStream:
    """Balise readings."""
    return BaliseStream(time, tuple(table.words["id"].each()), _known(table, "sigma_m"))


#: Decimals in the text files of a run.
DECIMALS: Mapping[str, int] = {
    "time_s": 6,
    "latitude_deg": 10,
    "longitude_deg": 10,
    "height_m": 5,
    "speed_m_s": 6,
    "course_deg": 6,
    "sigma_east_m": 5,
    "sigma_north_m": 5,
    "sigma_up_m": 5,
    "sigma_speed_m_s": 6,
    "quality": 0,
    "satellites": 0,
    "hdop": 3,
    **{f"gyro_{axis}_rad_s": 10 for axis in "xyz"},
    **{f"accel_{axis}_m_s2": 8 for axis in "xyz"},
    "temperature_c": 4,
    "distance_m": 5,
    "roll_deg": 8,
    "pitch_deg": 8,
    "heading_deg": 8,
    "gauge_mm": 4,
    "cant_mm": 4,
    "sigma_m": 5,
}


def stream_columns(run: Run, name: str) -> dict[str, FloatArray | Words]:
    """Columns of a stream in the units of its file; those it does not have are left out."""
    stream: Any = getattr(run, name)
    if stream is None:
        return {}
    columns: dict[str, Any] = {"time_s": stream.time}
    match stream:
        case GnssStream():
            columns |= {
                "latitude_deg": np.rad2deg(stream.latitude),
                "longitude_deg": np.rad2deg(stream.longitude),
                "height_m": stream.height,
                "sigma_east_m": stream.sigma_east,
                "sigma_north_m": stream.sigma_north,
                "sigma_up_m": stream.sigma_up,
                "speed_m_s": stream.speed,
                "course_deg": None if stream.course is None else np.rad2deg(stream.course),
                "sigma_speed_m_s": stream.sigma_speed,
                "quality": stream.quality,
                "satellites": stream.satellites,
                "hdop": stream.hdop,
            }
        case ImuStream():
            columns |= {f"gyro_{axis}_rad_s": stream.gyro[:, i] for i, axis in enumerate("xyz")}
            columns |= {f"accel_{axis}_m_s2": stream.specific_force[:, i] for i, axis in enumerate("xyz")}
            columns["temperature_c"] = None if stream.temperature is None else stream.temperature - CELSIUS
        case OdometerStream():
            columns |= {
                "distance_m": stream.distance,
                "speed_m_s": stream.speed,
                "sigma_speed_m_s": stream.sigma_speed,
            }
        case GyroAnglesStream():
            columns |= {
                "roll_deg": np.rad2deg(stream.roll),
                "pitch_deg": np.rad2deg(stream.pitch),
                "heading_deg": np.rad2deg(stream.heading),
            }
        case GaugeStream():
            columns |= {
                "gauge_mm": stream.gauge * 1000,
                "cant_mm": None if stream.cant is None else stream.cant * 1000,
            }
        case BaliseStream():
            columns |= {"id": Words.of(stream.id), "sigma_m": stream.sigma}
    return {key: value for key, value in columns.items() if value is not None}
