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
        refusals = f"`{order}` refused", f"`{order}` of walk_client refused", "torque stays off"
        number, end, said, refused, v = 0, time.monotonic() + seconds, "", False, struct.pack("<dd", speed, 0.0)
        while time.monotonic() < end and not said.startswith(done):
            time.sleep(0.05)  # 20 Hz; an order that is repeated keeps the lease
            if (sample := states.try_recv()) is None:
                continue
            frame, before = sample.payload.to_bytes(), said
            state = msgpack.unpackb(frame[4 : 4 + struct.unpack_from("<I", frame)[0]])[3]  # stamp, mode, reason and so on
            said, refused = "; ".join((f"{state[1]}: {state[2]}", *state[21])), any(w.startswith(refusals) for w in state[21])
            if not number or (refused and state[0] > number + 1_000_000_000):
                number = state[0]  # [ns] by the robot's clock; an order that was refused is given again, as a new one
            send("mode", "ModeCommand:73c90002", b"", state[0], order, number, "walk_client", False)
            send("velocity", "VelocityCommand:0708be15", v, state[0], ["<f8", [2], 0], 0.0, 0.11, 0.04, "tripod", *2 * [False])
            if said != before:
                print(said, flush=True)
        if refused or (order != "walk" and not said.startswith(done)):
            sys.exit(f"`{order}` is not done within {seconds} s: {said or 'no message from the robot'}")
