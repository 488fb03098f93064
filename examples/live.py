"""Calibrate while the sensors deliver
======================================

Read lines of text from a socket into ``Replay``::

    python examples/live.py HOST PORT      # a server that sends the lines below
    python examples/live.py                # plays the short run to itself, over a link that breaks

Lines, each with the time of its measurement::

    $GPGGA,hhmmss.ss,...*hh                                  GNSS, NMEA 0183
    wrz,vx,vy,vz,y,altitude,fom,covariance,time_us,...*hh    DVL, Water Linked's serial protocol
    $PIMU,seconds of day,gx,gy,gz,ax,ay,az*hh                IMU, rad/s and m/s²

A line that is cut or damaged is counted and left out. When the link breaks, the script connects
again; what the sensors measured meanwhile is missing. Nothing is sent to any instrument.
"""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import factorgraph_dvl as fd
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.verdict import Grade, grades, verdict_of
from factorgraph_dvl.replay.record import Update
from factorgraph_dvl.sensors.imu import Imu

SHORT_RUN = Path(__file__).parent / "short.yaml"
DAY = 86400.0
# Seconds without a line after which the link counts as broken, and between two attempts.
SILENCE, RETRY = 5.0, 0.2


def checksum(body: bytes) -> int:
    """Return NMEA's checksum: all bytes combined by exclusive or."""
    return reduce(xor, body, 0)


def crc8(body: bytes) -> int:
    """Return the checksum of Water Linked's lines: CRC-8 with the polynomial 0x07."""
    crc = 0
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1) ^ 0x07 if crc & 0x80 else crc << 1
        crc &= 0xFF
    return crc


@dataclass
class Feed:
    """Lines to records, and records to a replay.

    Parameters
    ----------
    settings : Trial
        What is known of the sensors; its records are not used.
    """

    settings: fd.Trial
    damaged: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.replay = fd.Replay(self.settings)

    def line(self, line: bytes) -> list[str]:
        """Take one line, and return what is to be shown."""
        body, star, stated = line.strip().rpartition(b"*")
        is_nmea = body.startswith(b"$")
        try:
            expected = checksum(body[1:]) if is_nmea else crc8(body)
            if not star or int(stated, 16) != expected:
                raise ValueError("the checksum is wrong")
            return self._take(body.decode("ascii").split(","))
        except (ValueError, IndexError, fd.DataError):
            self.damaged[line[:6].decode("ascii", "replace")] += 1
            return []

    def _take(self, fields: list[str]) -> list[str]:
        if fields[0] == "$PIMU":
            t, *values = (float(text) for text in fields[1:8])
            updates = self.replay.add_imu(t, values[:3], values[3:])
            return [text for update in updates for text in self.show(update)]
        if fields[0] == "$GPGGA" and fields[6] != "0":
            self.replay.add(self._gnss(fields))
        elif fields[0] == "wrz":
            self.replay.add(self._dvl(fields))
        return []

    def _gnss(self, f: list[str]) -> fd.Gnss:
        seconds = 3600.0 * int(f[1][:2]) + 60.0 * int(f[1][2:4]) + float(f[1][4:])
        lat = (int(f[2][:2]) + float(f[2][2:]) / 60.0) * (1.0 if f[3] == "N" else -1.0)
        lon = (int(f[4][:3]) + float(f[4][3:]) / 60.0) * (1.0 if f[5] == "E" else -1.0)
        # Height above the geoid plus that of the geoid above the ellipsoid.
        geodetic = np.array([[np.radians(lat), np.radians(lon), float(f[9]) + float(f[11])]])
        absent = np.full((1, 3), np.nan)
        given = self.settings.gnss
        assert given is not None
        return fd.Gnss(given.settings, np.array([seconds]), geodetic, absent, absent, absent)

    def _dvl(self, f: list[str]) -> fd.Dvl:
        velocity = np.array([[float(text) for text in f[1:4]]])
        if f[4] != "y":
            velocity[:] = np.nan
        given = self.settings.dvl
        assert given is not None
        seconds = np.array([int(f[8]) / 1e6 % DAY])
        return fd.Dvl(given.settings, seconds, velocity, np.full((1, 3), np.nan))

    def show(self, update: Update) -> Iterator[str]:
        """Yield a line for every whole ten seconds: verdict and grades."""
        # A batch solution looks at all records again.
        kept = [] if update.solved else self.findings
        self.findings = [*kept, *update.findings]
        if not update.solved and round(update.time * 5.0) % 50:
            return
        verdict = verdict_of(self.findings)
        worst: dict[str, Grade] = {}
        for e in update.calibration.estimates:
            limit = self.settings.limits.get(e.name)
            if limit is not None:
                found = grades(e.std, e.observable, limit)
                worst[e.name] = max(found, key=("green", "orange", "red", "grey").index)
        shown = ", ".join(f"{name} {grade}" for name, grade in worst.items())
        yield f"{update.time:9.1f} s  {verdict.grade}  {shown}"
        if verdict.reasons:
            yield f"             {verdict.reasons[0]}"


def lines(host: str, port: int, *, attempts: int = 1_000_000) -> Iterator[bytes]:
    """Yield whole lines from a server; connect again when the link breaks or falls silent.

    Parameters
    ----------
    host : str
        Name or address.
    port : int
        TCP port.
    attempts : int, optional
        Connections in a row without a line after which to give up.
    """
    failed = 0
    while failed < attempts:
        try:
            with socket.create_connection((host, port), timeout=SILENCE) as link:
                rest = b""
                while block := link.recv(65536):
                    *whole, rest = (rest + block).split(b"\n")
                    failed = 0
                    yield from whole
        except OSError as error:
            print(f"link lost: {error}", file=sys.stderr)
        failed += 1
        time.sleep(RETRY)


def sentence(body: str) -> bytes:
    """Return an NMEA sentence with its checksum."""
    return f"${body}*{checksum(body.encode()):02X}\r\n".encode()


def recorded_lines(trial: fd.Trial) -> list[bytes]:
    """Return the lines that the sensors of a recorded trial would have sent, in order."""
    assert trial.imu is not None
    assert trial.gnss is not None
    assert trial.dvl is not None
    out: list[tuple[float, bytes]] = []
    for t, rate, force in zip(*_samples(trial.imu), strict=True):
        numbers = ",".join(f"{x:.10g}" for x in (*rate, *force))
        out.append((t, sentence(f"PIMU,{t:.6f},{numbers}")))
    for t, place in zip(trial.gnss.time, trial.gnss.geodetic, strict=True):
        lat, lon = np.degrees(place[:2])
        clock = f"{int(t // 3600):02}{int(t // 60 % 60):02}{t % 60:09.6f}"
        north = f"{int(lat):02}{lat % 1.0 * 60:013.10f},N"
        east = f"{int(lon):03}{lon % 1.0 * 60:013.10f},E"
        out.append(
            (t, sentence(f"GPGGA,{clock},{north},{east},4,12,0.8,{place[2]:.4f},M,0.0,M,,"))
        )
    for t, v in zip(trial.dvl.time, trial.dvl.velocity, strict=True):
        body = f"wrz,{v[0]:.5f},{v[1]:.5f},{v[2]:.5f},y,20.0,0.002,0;0;0,{round(t * 1e6)},0,500,0"
        out.append((t, f"{body}*{crc8(body.encode()):02x}\r\n".encode()))
    return [line for _, line in sorted(out, key=lambda row: row[0])]


def _samples(imu: Imu) -> tuple[NDArray[np.float64], ...]:
    return imu.time, imu.gyro, imu.accel


def serve(sent: list[bytes], *, breaks: int = 2) -> int:
    """Send lines from a port of this machine, which is returned, with gaps and lost links.

    Parameters
    ----------
    sent : list of bytes
        The lines.
    breaks : int, optional
        How often the link breaks in the middle of a line. The lines of half a second are lost
        then, and one after it is damaged.
    """
    server = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        parts = np.array_split(np.arange(len(sent)), breaks + 1)
        for i, part in enumerate(parts):
            link, _ = server.accept()
            with link:
                begin = part[0] + (27 if i else 0)
                text = b"".join(sent[begin : part[-1] + 1])
                damaged = b"$GPGGA,999999,damaged*00\r\n" if i else b""
                link.sendall(damaged + (text[:-9] if i < breaks else text))
        server.close()

    threading.Thread(target=run, daemon=True).start()
    return int(server.getsockname()[1])


def main() -> Feed:
    """Connect, show, and show at the end what was damaged."""
    simulated = fd.simulate(SHORT_RUN, seed=1)
    settings = replace(simulated, calibration_truth={}, reference=None)
    if len(sys.argv) == 3:
        host, port, attempts = sys.argv[1], int(sys.argv[2]), 1_000_000
    else:
        host, port, attempts = "127.0.0.1", serve(recorded_lines(simulated)), 5
    feed = Feed(settings)
    for line in lines(host, port, attempts=attempts):
        for text in feed.line(line):
            print(text, flush=True)
    for update in feed.replay.finish():
        for text in feed.show(update):
            print(text)
    print(f"damaged lines: {sum(feed.damaged.values())}")
    return feed


if __name__ == "__main__":
    main()
