"""Samples of files, in the words of the documents."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import format_writers as writers
import numpy as np

WHEN = datetime(2021, 3, 4, 5, 6, 7, 120000, UTC)


def ensemble(number=1, velocity=(0.1, -0.2, 0.3, 0.4), more=(), **leader):
    when = WHEN + timedelta(seconds=number)
    names = ("heading", "pitch", "roll", "century")
    variable = {name: leader.pop(name) for name in names if name in leader}
    return writers.pd0(
        [
            writers.fixed_leader(**leader),
            writers.variable_leader(number, when, **variable),
            writers.water_profile([(4464, -4464, 3, -32768), (5, 6, 7, 8)]),
            writers.bottom_track(velocity, (10.0, 700.0, 12.34, 0.0)),
            *more,
        ]
    )


def rows(count, start=1000.0):
    rng = np.random.default_rng(2)
    values = rng.uniform(0.01, 1.0, (count, 17)) * np.where(
        rng.random((count, 17)) < 0.5, -1.0, 1.0
    )
    values[:, 0] = start + 0.005 * np.arange(count)
    return values


def deviations(count, start=1000.0):
    """Return rows (count, 10) of smrmsg: time, then north, east, down; arc minutes at the end."""
    out = np.tile([0.0, 0.2, 0.1, 0.3, 0.02, 0.01, 0.03, 0.6, 1.2, 3.0], (count, 1))
    out[:, 0] = start + np.arange(count)
    return out


HEADER = b"""% program   : RTKLIB ver.demo5 b31
% obs start : 2019/06/08 08:03:55.5 GPST (week2056 547435.5s)
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp)
"""


COLUMNS = b"latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"


VALUES = b"   47.060027749   -1.350495019    84.8600   1  12   0.0031   0.0025   0.0068"


WHEN = datetime(2021, 3, 4, 5, 6, 7, 120000, UTC)


SERIAL = b"""wrz,0.120,-0.400,2.000,y,1.30,1.855,1e-07;0;1.4;0;1.2;0;0.2;0;1e+09,7,14,123.00,1*50
wru,0,0.070,1.10,-40,-95*9c
wru,1,-0.500,1.25,-62,-104*f0
wru,2,2.200,1.40,-56,-98*18
wru,3,1.800,1.35,-58,-96*a3
wrx,1075.51,0.000,0.000,0.000,2.707,-1.00,n,1*04
wrp,49056.809,0.41,0.15,1.23,0.4,53.9,13.0,19.3,0*de
wrz,9.120,-0.400,2.000,y,1.30,1.855,1e-07;0;1.4;0;1.2;0;0.2;0;1e+09,7,14,123.00,1*50
"""


def rowe_ensemble(
    number=1,
    sentence=b"",
    beams=(0.1, 88.888, 0.3, 0.4),
    instrument=(0.5, -0.6, 0.7, 0.01),
    pings=1.0,
):
    ranges, other, count = [10.0, 0.0, 11.0, 12.0], [1.0] * 12, [1.0] * 4
    bottom = [*ranges, *other, *beams, *count, *instrument, *count, 1.0, 2.0, 3.0, 0.0, *count]
    return writers.rowe(number, WHEN, bottom, sentence, pings)


PD13 = """:SA, +1.50, -2.25,181.02
:TS,21030405060712,35.0,+10.5,  12.3,1501.0,  0
:RA,101.30, 100.50,  99.00,   0.00, 101.25
:BI, +123, -456, +1000,   +2,A
:BS, +456, +123, +1000,A
:BE, +1, +2, +3,A
:BD,     +1.00,     +2.00,     +3.00,  10.10,  0.00
"""


# A burst of the protocol "Phins standard", as a public reader prints it.
PIXSE = b"""$HEHDT,116.581,T*25
$PIXSE,ATITUD,-1.641,-0.490*6D
$PIXSE,POSITI,53.10245714,8.83994382,-0.115*71
$PIXSE,SPEED_,-0.802,-1.243,0.000*6F
$PIXSE,UTMWGS,U,32,489284.019,5883680.109,-0.115*39
$PIXSE,HEAVE_,-0.000,-0.000,0.014*7C
$PIXSE,TIME__,003356.016693*64
$PIXSE,STDHRP,1.997,0.082,0.101*7C
$PIXSE,STDPOS,20563.20,18004.65,50.00*7D
$PIXSE,STDSPD,19.747,13.032,10.002*41
$PIXSE,ALGSTS,00000045,00004000*60
"""

# Reports of a Water Linked DVL as a table, with the stamps of a computer.
_BEAM_COLUMNS = ("id", "velocity", "distance", "beam_valid")
WATER_LINKED_TABLE = (
    ",".join(
        [
            *["time", "vx", "vy", "vz", "fom", "altitude", "velocity_valid", "status"],
            *(f"transducers_{i}_{name}" for i in range(4) for name in _BEAM_COLUMNS),
        ]
    )
    + "\n"
    + "".join(
        f"{1638191471.5 + 0.25 * i},0.5,{0.01 * i},-0.1,0.02,1.5,{i % 4 != 0},0,"
        + ",".join(f"{beam},0.{beam}1,1.{beam},True" for beam in range(4))
        + "\n"
        for i in range(40)
    )
).encode()


def underwater_gps(count=40, start=1_700_000_000.0, heading=90.0):
    """Return tables of an Underwater GPS by their names, and of the sentences it was given.

    The vessel lies at 54°N 3°W; the vehicle is 10 m ahead of it and 5 m to starboard, 3 m deep.
    """
    out = {
        "acoustic": "timestamp,position_valid,x,y,z,std,valid_r0\n",
        "position": "timestamp,lat,lon,orientation,fix_quality,hdop,numsats,cog,sog\n",
        "global": "timestamp,lat,lon,orientation,fix_quality,hdop,numsats,cog,sog\n",
        "gga": "timestamp,utc,latitude,longitude,fix_quality,numsats,hdop,orthometric_height\n",
        "hdt": "timestamp,heading\n",
        "orientation": "timestamp,roll,pitch,yaw,state,progress\n",
    }
    for i in range(count):
        at = start + 0.25 * i
        clock = f"2213{20 + i // 4:02d}.{i % 4 * 25:02d}"
        # Asked twice for each place.
        out["acoustic"] += f"{at},{i % 8 < 6},{10 + 0.001 * (i // 2)},5.0,3.0,1.5,1\n"
        out["position"] += f"{at},54.0,-3.0,{heading},4,0.8,24,0,0\n"
        out["global"] += f"{at},54.00001,-3.0,-1,1,0.8,24,-1,-1\n"
        out["gga"] += f"{at},{clock},54.0,-3.0,4,24,0.8,1.4\n"
        out["hdt"] += f"{at},{heading}\n"
        out["orientation"] += f"{at},1.0,358.0,12.0,0,0\n"
    return {name: text.encode() for name, text in out.items()}


def usbl_sentences(count=40):
    """Return fixes of two transponders by `$PSIMSSB`, and of another one by `$PTSAG`."""
    lines = []
    for k in range(count):
        at = f"1200{k % 60:02d}.00"
        lines += [
            writers.nmea(f"PSIMSSB,{at},B0{1 + k % 2},A,,C,H,M,5.0,{10.0 + k},30.0,1.5,N,,"),
            writers.nmea(
                f"PTSAG,#{k:05d},{at},01,06,2023,1,5400.00{k:02d},N,00300.00,W,F,30.1,1,"
            ),
        ]
    return b"".join(lines)


def stamped_lines(count=40, start=300.0):
    """Return lines of PD6 as a logger stamps them: 57 of 60 whole, as on a bad cable."""
    out = "Timestamp(s),SensorID,RawLine,CmdOrNote\n"
    out += f'{start},DVL,":CS,",CMD\n{start},DVL,"nonsense, of no type",\n'
    for i in range(count):
        at = start + 0.1 * i
        lines = [
            f":SA,{1.5:+6.2f},{-2.25:+6.2f},{181.0 + i:6.2f}",
            ":TS,00010100000194,35.0,+25.0,   0.0,1500.0,003",
            f":WI,{120:+6d},{-i:+6d},{3:+6d},{0:+6d},A",
            f":BI,{100 + i:+6d},{-20:+6d},{3:+6d},{1:+6d},{'V' if i == 5 else 'A'}",
            f":BD,{0.0:+12.2f},{0.0:+12.2f},{0.0:+12.2f},{5.84:+7.2f},{0.09:6.2f}",
        ]
        if i % 20 == 7:
            # A digit is lost: of 107 mm/s, 17 are left.
            lines[3] = lines[3].replace("0", "", 1)
        out += "".join(f'{at + 0.002 * k:.6f},DVL,"{line}",\n' for k, line in enumerate(lines))
    return out.encode()


def winriver_settings(*files):
    """Return a measurement file with a transect for each (name, variation)."""
    out = '<?xml version="1.0" encoding="utf-8"?>\n<WinRiver><Project Name="a" Version="2.18">'
    out += "<Site_Information/><Site_Discharge>"
    for name, variation in files:
        out += f'<Transect Checked="1"><File PathName="C:\\x" TransectNmb="0">{name}</File>'
        # What was set in the field, and what is in force.
        for checked, value in ((0, 99.0), (1, variation)):
            out += (
                f'<Configuration Checked="{checked}"><Offsets><Magnetic_Variation Status="2">'
                f"{value}</Magnetic_Variation><ADCP_Transducer_Depth>0.25</ADCP_Transducer_Depth>"
                "</Offsets><Ext_Heading><Offset>1.5</Offset></Ext_Heading><GPS><Time_Delay>0"
                "</Time_Delay></GPS></Configuration>"
            )
        out += "</Transect>"
    return (out + "</Site_Discharge></Project></WinRiver>\n").encode()
