"""Stands a robot up, walks it forward for some seconds, stops it and lets it sit: python walk_client.py [tcp/HOST:7447]"""

import struct
import sys
import time

import msgpack
import zenoh

ROUTER = zenoh.Config.from_json5(str({"mode": "client", "connect": {"endpoints": sys.argv[1:] or ["tcp/127.0.0.1:7447"]}}))
ORDERS = ("stand", "hold: standing", 15, 0.0), ("walk", "off", 8, 0.06), ("stop", "hold", 5, 0.0), ("sit", "ready", 10, 0.0)


def send(key, schema, arrays, *fields):  # a frame: the header's length, the header, padding to 8 bytes, the arrays
    header = msgpack.packb([schema, 0, 0, fields])
    robot.put(f"sextant/operator/{key}", struct.pack("<I", len(header)) + header + bytes(-(4 + len(header)) % 8) + arrays)


with zenoh.open(ROUTER) as robot, robot.declare_subscriber("sextant/actuator/state", zenoh.handlers.RingChannel(1)) as states:
    for order, done, seconds, speed in ORDERS:  # repeated until the robot reports it as done, or the time is over
        number, end, said, v = 0, time.monotonic() + seconds, "", struct.pack("<dd", speed, 0.0)
        while time.monotonic() < end and not said.startswith(done):
            frame, before = states.recv().payload.to_bytes(), said
            state = msgpack.unpackb(frame[4 : 4 + struct.unpack_from("<I", frame)[0]])[3]  # stamp, mode, reason and so on
            number, said = number or state[0], "; ".join((f"{state[1]}: {state[2]}", *state[21]))
            send("mode", "ModeCommand:73c90002", b"", state[0], order, number, "walk_client", False)  # by the robot's clock
            send("velocity", "VelocityCommand:ac25fe80", v, state[0], ["<f8", [2], 0], 0.0, 0.11, 0.04, "tripod", False)
            time.sleep(0.05)  # 20 Hz; an order that is repeated keeps the lease
            if said != before:
                print(said, flush=True)
