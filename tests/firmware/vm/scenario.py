# Runs in MicroPython: the firmware of /board against a radio, a wire and a clock that follow a scenario.
# Time passes only where the firmware sleeps, so every figure is in the firmware's own time.
import gc
import json
import sys

with open("/board/scenario.json") as file:
    PLANS = json.load(file)
PLAN = {}
PERIOD = 1 << 30


class Done(BaseException):
    pass


class World:
    """Everything outside the firmware; a new one for each plan."""


def renew():
    World.us = World.begin = PLAN.get("start_us", 0)
    World.log = []  # [ms, what, text]
    World.room = 1 << 30
    World.incoming = bytearray()
    World.irq = World.pin_irq = None
    World.values = {}
    World.fed = 0


def note(what, text):
    World.log.append([(World.us - World.begin) / 1000, what, text])


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
        World.irq = handler

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
        World.irq(28, (0, 1, value, 1, 16))
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
        World.pin_irq(None)
    elif action == "passkey":
        World.irq(31, (0, 3, 0))
    elif action == "interrupt":
        raise KeyboardInterrupt
    elif action == "fault":
        raise ValueError("a fault of the radio")
    elif action == "collect":
        gc.collect()
        note("free", str(gc.mem_free()))


def sleep_ms(duration):
    # A round of the loop costs time, too.
    target = World.us + duration * 1000 + PLAN.get("round_us", 300)
    while PLAN["actions"] and World.begin + PLAN["actions"][0][0] * 1000 <= target:
        when, action, value = PLAN["actions"].pop(0)
        World.us = max(World.us, World.begin + int(when * 1000))
        do(action, value)
    World.us = max(World.us, target)
    if World.us - World.begin >= PLAN["end_ms"] * 1000:
        raise Done


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


def run(plan):
    global PLAN
    PLAN = plan
    renew()
    for name in list(sys.modules):
        if name.startswith("tagid_bridge"):
            del sys.modules[name]
    ended = "done"
    try:
        with open("/board/main.py") as file:
            exec(file.read(), {})
    except Done:
        pass
    except KeyboardInterrupt:
        ended = "prompt"
    return {"log": World.log, "fed": World.fed, "ended": ended, "info": World.values[5].hex()}


for plan in PLANS:
    gc.collect()
    print(json.dumps(run(plan)))
