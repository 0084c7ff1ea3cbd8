"""An MTConnect agent for tests: the documents of the standard, written by us, over real HTTP; its clock is ours."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

BEGUN_S = 1_790_000_000.0
PROBE = """<?xml version="1.0" encoding="UTF-8"?>
<MTConnectDevices xmlns="urn:mtconnect.org:MTConnectDevices:2.0"><Header version="2.0" instanceId="{instance}"
 creationTime="{now}" sender="test" bufferSize="{buffer}" nextSequence="{next}" firstSequence="{first}" lastSequence="{last}"/>
<Devices>{devices}</Devices></MTConnectDevices>"""
DEVICE = """<Device id="d1" name="mill-7" uuid="M-7"><DataItems>
<DataItem category="EVENT" id="avail" type="AVAILABILITY"/></DataItems><Components>
<Axes id="ax" name="Axes"><Components><Linear id="x" name="X"><DataItems>
<DataItem category="SAMPLE" id="xpos" name="Xact" type="POSITION" subType="ACTUAL" units="MILLIMETER"/>
<DataItem category="SAMPLE" id="xload" name="Xload" type="LOAD" units="PERCENT"/>
<DataItem category="CONDITION" id="xcond" name="Xdrive" type="LOAD"/></DataItems></Linear>
<Rotary id="s" name="S"><DataItems>
<DataItem category="SAMPLE" id="sspeed" name="Sspeed" type="ROTARY_VELOCITY" units="REVOLUTION/MINUTE"/>
<DataItem category="SAMPLE" id="stemp" name="Stemp" type="TEMPERATURE" units="CELSIUS"/>
<DataItem category="SAMPLE" id="scurve" name="Scurve" type="AMPERAGE" units="AMPERE" representation="TIME_SERIES"/>
<DataItem category="SAMPLE" id="smood" name="Smood" type="x:MOOD" units="x:SMILE"/></DataItems></Rotary></Components></Axes>
<Controller id="c" name="controller"><Components><Path id="p" name="path"><DataItems>
<DataItem category="EVENT" id="prog" name="program" type="PROGRAM"/>
<DataItem category="EVENT" id="exec" name="execution" type="EXECUTION"/>
<DataItem category="EVENT" id="line" name="line" type="LINE"/>
<DataItem category="SAMPLE" id="ppos" name="path" type="PATH_POSITION" units="MILLIMETER_3D"/></DataItems></Path></Components>
</Controller></Components></Device>"""
TAGS = {
    "xpos": "Position",
    "xload": "Load",
    "sspeed": "RotaryVelocity",
    "stemp": "Temperature",
    "prog": "Program",
    "exec": "Execution",
    "line": "Line",
    "ppos": "PathPosition",
}


def stamp(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class Agent:
    """What is observed, and how the agent answers.

    ``now_s``: its clock; moves when told.
    ``style``: of its errors: ``old`` with HTTP 200, ``new`` with 404 and a tag that names the error.
    """

    def __init__(self, buffer: int = 1000) -> None:
        self.buffer, self.instance, self.now_s, self.style = buffer, 1001, BEGUN_S, "new"
        self.observed: list[tuple[int, float, str]] = []
        self.next, self.down, self.answers = 1, False, 0
        self.current: dict[str, str] = {}
        self.extra = ""
        self.body: bytes | None = None
        self._lock = threading.Lock()

    def observe(self, item: str, text: str, at_s: float | None = None, *, tag: str = "", code: str = "") -> None:
        with self._lock:
            time_s = self.now_s if at_s is None else BEGUN_S + at_s
            about = f' nativeCode="{code}"' if code else ""
            name = tag or TAGS[item]
            element = (
                f'<{name} dataItemId="{item}" sequence="{self.next}" timestamp="{stamp(time_s)}"{about}>{text}</{name}>'
            )
            self.observed.append((self.next, time_s, element))
            self.observed = self.observed[-self.buffer :]
            self.current[f"{item}{code}"] = element
            self.next += 1

    def restart(self) -> None:
        """Count anew, as after a power cut."""
        with self._lock:
            self.instance, self.next, self.observed, self.current = self.instance + 1, 1, [], {}

    @property
    def first(self) -> int:
        return self.observed[0][0] if self.observed else 1

    def answer(self, path: str) -> tuple[int, bytes]:
        with self._lock:
            self.answers += 1
            if self.body is not None:
                return 200, self.body
            parts = urlsplit(path)
            asked = {k: int(v[0]) for k, v in parse_qs(parts.query).items()}
            what = parts.path.rsplit("/", 1)[-1]
            if what == "probe":
                return 200, self._filled(PROBE.replace("{devices}", DEVICE + self.extra))
            if what == "current":
                return 200, self._streams([e for e in self.current.values()], self.next)
            if what == "sample":
                begin, count = asked.get("from", self.first), asked.get("count", 100)
                if begin < self.first or begin > self.next:
                    return self._error("OUT_OF_RANGE")
                chosen = [o for o in self.observed if begin <= o[0] < begin + count]
                return 200, self._streams([o[2] for o in chosen], min(begin + count, self.next))
            return self._error("UNSUPPORTED")

    def _streams(self, elements: list[str], following: int) -> bytes:
        # An agent sorts by component and category, not by sequence.
        body = "".join(sorted(elements, reverse=True))
        return self._filled(
            '<MTConnectStreams xmlns="urn:mtconnect.org:MTConnectStreams:2.0"><Header version="2.0" '
            'instanceId="{instance}" creationTime="{now}" bufferSize="{buffer}" firstSequence="{first}" '
            f'nextSequence="{following}" lastSequence="{{last}}"/><Streams><DeviceStream name="mill-7" uuid="M-7">'
            f'<ComponentStream component="Path" componentId="p"><Samples>{body}</Samples></ComponentStream>'
            "</DeviceStream></Streams></MTConnectStreams>"
        )

    def _error(self, code: str) -> tuple[int, bytes]:
        inside = f'<Errors><Error errorCode="{code}">not there</Error></Errors>'
        if self.style == "new" and code == "OUT_OF_RANGE":
            inside = (
                '<Errors><OutOfRange errorCode="OUT_OF_RANGE"><ErrorMessage>gone</ErrorMessage></OutOfRange></Errors>'
            )
        text = f'<MTConnectError xmlns="urn:mtconnect.org:MTConnectError:2.0"><Header/>{inside}</MTConnectError>'
        return (404 if self.style == "new" else 200), text.encode()

    def _filled(self, text: str) -> bytes:
        for name, value in (
            ("{instance}", self.instance),
            ("{now}", stamp(self.now_s)),
            ("{buffer}", self.buffer),
            ("{next}", self.next),
            ("{first}", self.first),
            ("{last}", self.next - 1),
        ):
            text = text.replace(name, str(value))
        return text.encode()


@contextmanager
def serving(agent: Agent) -> Iterator[str]:
    """Yield the address of an agent on loopback."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if agent.down:
                self.connection.close()
                return
            status, body = agent.answer(self.path)
            self.send_response(status)
            self.send_header("Content-Type", "text/xml")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()
