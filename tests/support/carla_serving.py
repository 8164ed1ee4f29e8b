"""A `roadproof carla serve` in a process of its own, and a small map, a drive on it and cameras for it."""

import contextlib
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time

from command import PROGRAM
from roadproof.datatypes import VehicleState
from roadproof.geometry import CameraModel, CanvasPlacement, CropResize
from roadproof.scenarios import Scenario

START_S = 300.0
CAMERA = CameraModel(width_px=320, height_px=240, fov_deg=100.0, forward_m=2.0, up_m=1.4, pitch_deg=-15.0)
INPUT = CropResize(left_px=0, top_px=46, right_px=320, bottom_px=204, width_px=160, height_px=79)
# Half of the published camera, and of what is cut from it: the controller's frame is as large as ever.
HALF = CameraModel(width_px=400, height_px=300, fov_deg=100.0, forward_m=2.0, up_m=1.4, pitch_deg=-15.0)
HALF_INPUT = CropResize(left_px=0, top_px=57, right_px=400, bottom_px=255, width_px=200, height_px=88)
SMALL = CameraModel(width_px=80, height_px=60, fov_deg=100.0, forward_m=2.0, up_m=1.4, pitch_deg=-15.0)
SMALL_INPUT = CropResize(left_px=0, top_px=12, right_px=80, bottom_px=51, width_px=80, height_px=39)
STREET = Scenario(
    name="street",
    kind="straight",
    map_name="street",
    start=VehicleState(20.0, -1.75, 0.0, 0.0, 0.0),
    goal_m=(140.0, -1.75),
    canvas=CanvasPlacement(x_m=50.0, y_m=0.0, width_m=6.0),
    time_limit_s=30.0,
)


def straight_map(folder, length_m=160.0):
    """A straight street with a pavement on both sides."""
    width = '<width sOffset="0" a="{}" b="0" c="0" d="0"/>'
    mark = '<roadMark sOffset="0" type="{}" weight="standard" color="{}" width="0.15" laneChange="none"/>'
    lanes = {
        side: f'<{side}><lane id="{sign}1" type="driving" level="false"><link/>{width.format(3.5)}'
        f'{mark.format("solid", "standard")}</lane><lane id="{sign}2" type="sidewalk" level="false"><link/>'
        f"{width.format(2.5)}</lane></{side}>"
        for side, sign in (("left", ""), ("right", "-"))
    }
    path = folder / "street.xodr"
    path.write_text(
        '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1.0">'
        "<geoReference><![CDATA[+proj=tmerc +lat_0=0 +lon_0=0]]></geoReference></header>"
        f'<road name="street" length="{length_m}" id="1" junction="-1"><link/><planView>'
        f'<geometry s="0" x="0" y="0" hdg="0" length="{length_m}"><line/></geometry></planView>'
        '<elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/></elevationProfile><lanes>'
        f'<laneSection s="0">{lanes["left"]}<center><lane id="0" type="none" level="false">'
        f"{mark.format('broken', 'yellow')}</lane></center>{lanes['right']}</laneSection></lanes></road></OpenDRIVE>"
    )
    return path


def free_port():
    """A port that is free, and the next one too."""
    for _ in range(50):
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
            with contextlib.suppress(OSError, OverflowError):
                second.bind(("127.0.0.1", port + 1))
                return port
    raise RuntimeError("no two ports beside each other are free")


def interruptible():
    """For a child process: SIGINT ends it, also where the tests run in the background and ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextlib.contextmanager
def serving(*arguments, program=PROGRAM):
    """Serve; yields the process and its port, once it answers."""
    command = [sys.executable, "-c", program, "carla", "serve", "--port", "0", *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, env=environment, preexec_fn=interruptible, **pipes) as process:
        try:
            said = b""
            until = time.monotonic() + START_S
            while not (found := re.search(rb"Serving .*:(\d+) and (\d+);", said)):
                ready, _, _ = select.select([process.stdout], [], [], max(until - time.monotonic(), 0.0))
                chunk = os.read(process.stdout.fileno(), 4096) if ready else b""
                if not chunk:
                    raise RuntimeError(f"the server did not start: {said.decode()}")
                said += chunk
            port, streams = map(int, found.groups())
            assert streams == port + 1
            yield process, port
        finally:
            process.kill()
