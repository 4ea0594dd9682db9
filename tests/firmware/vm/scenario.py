"""Runs in MicroPython: the firmware of /board against a radio, a wire and a clock that follow a scenario.

Time passes only where the firmware sleeps, so every figure is in the firmware's own time.
"""

import gc
import json
import os
import sys

with open("/board/scenario.json") as file:
    PLANS = json.load(file)
PLAN = {}
PERIOD = 1 << 30
IDLE_US = 480_000_000  # a round while the scenario idles: shorter than half a period of ticks_us
SCHEDULED = 8  # MICROPY_SCHEDULER_DEPTH of the ESP32 port
PEER = b"\x01123456"


class Done(BaseException):
    pass


class World:
    """Everything outside the firmware; a new one for each plan."""


def renew():
    for name in ("bonds.json", "tries.json"):
        if name in os.listdir():
            os.remove(name)
    for name, text in PLAN.get("files", {}).items():
        with open(name, "w") as file:
            file.write(text)
    World.us = World.begin = PLAN.get("start_us", 0)
    World.log = []  # [us, what, text]
    World.scheduled = []
    World.next = 0
    World.before = World.peak = World.alive = 0
    World.room = 1 << 30
    World.incoming = bytearray()
    World.irq = World.pin_irq = None
    World.values = {}
    World.fed = 0
    World.idle_us = 0


def note(what, text):
    if not PLAN.get("measure"):  # the log itself would be measured
        World.log.append([World.us, what, text])


class Module:
    pass


def install(name, **members):
    module = Module()
    for key, value in members.items():
        setattr(module, key, value)
    sys.modules[name] = module


class UART:
    def __init__(self, *args, **options):
        note("open", str(options["baudrate"]))

    def init(self, baudrate):
        note("baud", str(baudrate))

    def any(self):
        return len(World.incoming)

    def read(self, count):
        data = bytes(World.incoming[:count])
        World.incoming = World.incoming[count:]
        return data

    def write(self, data):
        note("uart", bytes(data).hex())


class Pin:
    IN, OUT, OPEN_DRAIN, PULL_UP, IRQ_RISING, IRQ_FALLING = range(6)

    def __init__(self, number, *mode, **options):
        self.number = number

    def value(self, value):
        note("pin", "%d=%d" % (self.number, value))

    def irq(self, handler, trigger):
        World.pin_irq = handler


class WDT:
    def __init__(self, timeout):
        note("wdt", str(timeout))

    def feed(self):
        World.fed += 1


def UUID(text):  # noqa: N802 - the real one can be read as bytes, which no class written here can
    digits = text.replace("-", "")
    return bytes([int(digits[i : i + 2], 16) for i in range(30, -2, -2)])


class BLE:
    def active(self, on):
        pass

    def config(self, **settings):
        pass

    def irq(self, handler):
        # The scenario begins when the radio does: what was written before stands at times up to 0.
        World.irq = handler
        World.begin = World.us

    def gatts_register_services(self, services):
        handles = []
        number = 1
        for _, characteristics in services:
            handles.append(tuple(range(number, number + len(characteristics))))
            number += len(characteristics)
        World.values = {i: b"" for i in range(number)}
        return tuple(handles)

    def gatts_set_buffer(self, handle, size, append=False):
        pass

    def gatts_read(self, handle):
        return World.values[handle]

    def gatts_write(self, handle, data):
        World.values[handle] = bytes(data)

    def gatts_notify(self, connection, handle, data):
        if World.room <= 0:
            raise OSError(12)
        World.room -= 1
        note({2: "bytes", 4: "event"}[handle], bytes(data).hex())

    def gap_advertise(self, interval, data, resp_data):
        note("advertise", bytes(data).hex())

    def gap_passkey(self, connection, action, passkey):
        note("passkey", str(passkey))

    def gap_disconnect(self, connection):
        note("disconnect", "")


def do(action, value):
    if action == "connect":
        World.irq(1, (0, 0, b"123456"))
        World.irq(21, (0, value))
    elif action == "trust":
        # NimBLE's bond: peer, key size, ediv, rand (zero with Secure Connections), long-term key.
        bond = PEER + b"\x10" + bytes(8) + bytes(8) + b"K" * 16
        World.irq(30, (1, PEER, bond))
        World.irq(28, (0, 1, value, 1, 16))
    elif action == "legacy":
        World.irq(28, (0, 1, 1, 1, 16))
        World.irq(30, (1, PEER, PEER + b"\x10" + bytes(8) + b"RandomNo" + b"K" * 16))
    elif action == "pair":
        World.irq(30, (1, bytes([1, value]) + bytes(5), bytes(24) + b"K" * 16))
    elif action == "unpair":
        World.irq(30, (1, PEER, None))
    elif action == "again":
        note("secret", str(World.irq(29, (1, 0, PEER)) is not None))
        World.irq(28, (0, 1, 1, 1, 16))
    elif action == "lose":
        World.irq(2, (0, 0, b"123456"))
    elif action in ("rx", "command"):
        handle = 1 if action == "rx" else 3
        World.values[handle] = bytes([int(value[i : i + 2], 16) for i in range(0, len(value), 2)])
        World.irq(3, (0, handle))
    elif action == "robot":
        World.incoming = World.incoming + bytes([int(value[i : i + 2], 16) for i in range(0, len(value), 2)])
    elif action == "room":
        World.room = value
    elif action == "pulse":
        if len(World.scheduled) < SCHEDULED:
            World.scheduled.append(World.pin_irq)
    elif action == "busy":
        World.us += value * 1000
    elif action == "idle":
        World.idle_us = value * 1000
    elif action == "passkey":
        World.irq(31, (0, 3, 0))
    elif action == "interrupt":
        raise KeyboardInterrupt
    elif action == "break":
        World.irq(21, ())  # the radio's handler fails
    elif action == "file":
        text = ""
        if value in os.listdir():
            with open(value) as file:
                text = file.read()
        note(value, text)
    elif action == "erase":
        os.remove(value)
    elif action == "fault":
        raise ValueError("a fault of the radio")
    elif action == "collect":
        gc.collect()
        note("free", str(gc.mem_free()))


def sleep_ms(duration):
    # Idle time passes in few rounds, and the scenario's own time stands still meanwhile.
    if World.idle_us:
        step = min(World.idle_us, IDLE_US)
        World.us += step
        World.begin += step
        World.idle_us -= step
        return
    # A round of the loop costs time, too.
    target = World.us + duration * 1000 + PLAN.get("round_us", 300)
    while World.irq and not World.idle_us and due() <= target:
        when, action, value = PLAN["actions"][World.next]
        World.next += 1
        World.us = max(World.us, World.begin + int(when * 1000))
        do(action, value)
        if due() > World.us:
            serve()
    World.us = max(World.us, target)
    serve()
    if World.irq and World.us - World.begin >= PLAN["end_ms"] * 1000:
        raise Done


def serve():
    """Pin interrupts are scheduled: they run when the interpreter comes to them."""
    while World.scheduled:
        World.scheduled.pop(0)(None)


def due():
    """When the next action is due, us; they stay in the plan, whose memory must not change meanwhile."""
    actions = PLAN["actions"]
    return World.begin + actions[World.next][0] * 1000 if World.next < len(actions) else 1 << 60


def diff(later, earlier):
    return ((later - earlier + PERIOD // 2) % PERIOD) - PERIOD // 2


def reset():
    note("reset", "")
    raise Done


install(
    "time",
    ticks_us=lambda: World.us % PERIOD,
    ticks_ms=lambda: (World.us // 1000) % PERIOD,
    ticks_add=lambda ticks, delta: (ticks + delta) % PERIOD,
    ticks_diff=diff,
    sleep_ms=sleep_ms,
)
install(
    "machine",
    UART=UART,
    Pin=Pin,
    WDT=WDT,
    WDT_RESET=3,
    reset_cause=lambda: PLAN.get("reset_cause", 1),
    reset=reset,
)
install("bluetooth", UUID=UUID, BLE=BLE)


def begin(plan):
    global PLAN
    PLAN = plan
    renew()
    for name in list(sys.modules):
        if name.startswith("tagid_bridge"):
            del sys.modules[name]


def run(plan):
    begin(plan)
    ended = "done"
    try:
        with open("/board/main.py") as file:
            exec(file.read(), {})
    except Done:
        pass
    except KeyboardInterrupt:
        ended = "prompt"
    return report(ended)


def report(ended):
    log = [[(us - World.begin) / 1000, what, text] for us, what, text in World.log]
    info = World.values[5].hex() if World.values else ""
    memory = {"peak": World.peak, "alive": World.alive}
    return {"log": log, "fed": World.fed, "ended": ended, "info": info, "memory": memory}


# This machine collects garbage only between two calls from outside, so a measured plan is stepped by run.mjs:
# begin, a collection, begin_measured, then tick, a collection and sample for each round, then end_measured.


def begin_measured():
    global ENDED
    ENDED = False
    World.before = gc.mem_alloc()
    from tagid_bridge import control, settings
    from tagid_bridge.robot import Robot

    config, problem = settings.load()
    World.bridge = control.Bridge(config, problem, Robot(config))


def tick():
    """One round."""
    global ENDED
    World.bridge.step()
    World.peak = max(World.peak, gc.mem_alloc() - World.before)
    try:
        sleep_ms(1)
    except Done:
        ENDED = True


def sample():
    World.alive = max(World.alive, gc.mem_alloc() - World.before)


def end_measured():
    World.bridge = None
    print(json.dumps(report("done")))


ENDED = False
for plan in PLANS:
    if not plan.get("measure"):
        gc.collect()
        print(json.dumps(run(plan)))
