"""Run the scripts of the fleet's document in a real Home Assistant.

This program installs Home Assistant from PyPI in an environment of its own, and starts it without a screen. It also
starts mosquitto, a server and a bridge. It sets MQTT up as a user would, runs the documented scripts and the device's
entities, and prints a line for each check. The exit code is 0 if all checks succeed, 1 if one fails, and 77 if Home
Assistant can't be installed. The first run takes about five minutes, and later ones less than one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import traceback
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.fleet.robot import LONG, Robot
from tests.readme.blocks import block
from tests.support.bridge import Bridge
from tests.support.broker import Broker
from tests.support.ports import HOST, Port
from tests.support.processes import Talk
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: The newest Home Assistant for Python 3.13.0. Descriptions of devices need at least 2024.11.
VERSION, OLDEST_PYTHON = "2025.4.4", (3, 13)
NOT_INSTALLED = 77
#: Time for a start, and for the effect of an action, in seconds.
_START_S, _EFFECT_S = 300.0, 15.0
_SETTINGS = """homeassistant: {{name: Test, latitude: 52, longitude: 13, unit_system: metric, time_zone: UTC}}
http: {{server_host: {host}, server_port: {port}}}
api:
config:
onboarding:
script: !include scripts.yaml
automation: !include automations.yaml
"""


class NotInstallableError(Exception):
    """Home Assistant can't be installed here."""


class HomeAssistant:
    """A running Home Assistant, controlled by its REST API."""

    def __init__(self, program: Path, directory: Path, port: int) -> None:
        self._url, self._token = f"http://{HOST}:{port}", ""
        (directory / "configuration.yaml").write_text(_SETTINGS.format(host=HOST, port=port), "utf-8")
        (directory / "scripts.yaml").write_text(block("Home Assistant: Scripts"), "utf-8")
        (directory / "automations.yaml").write_text(block("Home Assistant: Scripts #2"), "utf-8")
        self.log = directory / "home-assistant.log"
        self._output = directory / "output"
        with open(self._output, "wb") as output:
            self._process = subprocess.Popen(
                [program, "-c", directory], stdout=output, stderr=output, start_new_session=True
            )

    def set_up(self, broker: Broker) -> None:
        """Wait until Home Assistant runs, create its user, and add the MQTT integration by its own dialogue."""
        user = {"name": "test", "username": "test", "password": "test", "language": "en", "client_id": f"{self._url}/"}
        code = self.wait(lambda: self.request("/api/onboarding/users", user)["auth_code"], _START_S)
        grant = f"grant_type=authorization_code&code={code}&client_id={self._url}/".encode()
        self._token = self.request("/auth/token", grant)["access_token"]
        self.wait(lambda: self.request("/api/config")["state"] == "RUNNING", _START_S)
        flow = self.request("/api/config/config_entries/flow", {"handler": "mqtt"}, limit=_START_S)
        done = self.request(
            f"/api/config/config_entries/flow/{flow['flow_id']}", {"broker": HOST, "port": broker.port}, limit=_START_S
        )
        assert done["type"] == "create_entry", done

    def request(self, path: str, body: Any = None, limit: float = 90.0) -> Any:
        """Send a request to the REST API, and return the decoded answer."""
        data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        request = urllib.request.Request(self._url + path, data)
        if self._token:
            request.add_header("Authorization", f"Bearer {self._token}")
        if data is not body:
            request.add_header("Content-Type", "application/json")
        with urllib.request.urlopen(request, timeout=limit) as answer:
            return json.load(answer)

    def act(self, action: str, **data: Any) -> Any:
        """Run an action such as `button.press`, and return once it has been carried out."""
        return self.request(f"/api/services/{action.replace('.', '/')}", data)

    def say_and_wait(self, text: object) -> dict[str, Any]:
        """Run the documented script, and return its response."""
        answer = self.request("/api/services/script/say_and_wait?return_response", {"robot": "anna", "text": text})
        response: dict[str, Any] = answer["service_response"]
        return response

    def set_paused(self, paused: bool) -> None:
        """Pause or resume the robot with its switch, and wait until the switch shows this."""
        state = "on" if paused else "off"
        self.act(f"switch.turn_{state}", entity_id="switch.anna_paused")
        self.wait_for("switch.anna_paused", state)

    def cancel(self) -> None:
        """Press the robot's button Cancel."""
        self.act("button.press", entity_id="button.anna_cancel")

    def state(self, entity: str) -> str:
        """Return the state of an entity."""
        return str(self.request(f"/api/states/{entity}")["state"])

    def wait(self, condition: Callable[[], Any], limit: float = _EFFECT_S) -> Any:
        """Wait until a condition is true, and return its value. Home Assistant may not answer meanwhile."""
        end = time.monotonic() + limit
        while True:
            with contextlib.suppress(OSError):
                if value := condition():
                    return value
            assert self._process.poll() is None, f"Home Assistant ended: {self._output.read_text('utf-8')[-2000:]}"
            assert time.monotonic() < end, f"not within {limit:g} s"
            time.sleep(0.1)

    def wait_for(self, entity: str, state: str) -> None:
        """Wait until an entity is in a state."""
        self.wait(lambda: self.state(entity) == state)

    def close(self) -> None:
        """End Home Assistant."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            if self._process.poll() is None:
                os.killpg(self._process.pid, number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(30)


def check_device(home: HomeAssistant, _: Robot) -> None:
    for entity, state in {"sensor.anna_state": "idle", "switch.anna_paused": "off", "sensor.anna_pending": "0"}.items():
        home.wait_for(entity, state)
    for entity in ("notify.anna", "notify.anna_interrupt", "button.anna_cancel", "event.anna_sentence_ended"):
        home.wait_for(entity, "unknown")


def check_notify(home: HomeAssistant, robot: Robot) -> None:
    home.act("notify.send_message", entity_id="notify.anna", message="it's <one>\nÄ & {{ two }}")
    home.wait_for("sensor.anna_last_result", "SUCCEEDED")
    assert robot.spoken[-1] == "it's <one>\nÄ & {{ two }}"


def check_own_result(home: HomeAssistant, robot: Robot) -> None:
    done = {"state": "SUCCEEDED", "reason": None, "message": "Talk completed successfully"}
    assert [home.say_and_wait('it\'s "one"\nÄ {{ two }}'), home.say_and_wait(21.5)] == [done, done]
    home.wait(lambda: robot.spoken[-2:] == ['it\'s "one"\nÄ {{ two }}', "21.5"])
    home.set_paused(True)
    with ThreadPoolExecutor(10) as pool:
        results = [pool.submit(home.say_and_wait, f"number {number}") for number in range(10)]
        home.wait_for("sensor.anna_pending", "10")
        home.cancel()
        assert [each.result()["state"] for each in results] == ["RECALLED"] * 10
    home.set_paused(False)


def check_interrupt(home: HomeAssistant, robot: Robot) -> None:
    home.act("notify.send_message", entity_id="notify.anna", message=LONG)
    home.wait_for("binary_sensor.anna_speaking", "on")
    home.act("notify.send_message", entity_id="notify.anna_interrupt", message="fire")
    home.wait(lambda: "fire" in robot.spoken)
    home.wait_for("binary_sensor.anna_speaking", "off")


def check_interjection(home: HomeAssistant, robot: Robot) -> None:
    home.act("notify.send_message", entity_id="notify.anna", message="never-ends words=1")
    home.wait_for("binary_sensor.anna_speaking", "on")
    robot.talk.run("say", "--wait", "--interject", "length=0")
    home.wait_for("sensor.anna_last_result", "SUCCEEDED")
    assert home.state("binary_sensor.anna_speaking") == "on"
    home.cancel()
    home.wait_for("binary_sensor.anna_speaking", "off")


def check_pause(home: HomeAssistant, robot: Robot) -> None:
    robot.talk.run("pause")  # by somebody else
    home.wait_for("switch.anna_paused", "on")
    robot.talk.run("resume")
    home.wait_for("switch.anna_paused", "off")
    home.set_paused(True)
    home.act("notify.send_message", entity_id="notify.anna", message="after the pause")
    home.wait_for("sensor.anna_pending", "1")
    home.set_paused(False)
    home.wait(lambda: robot.spoken[-1] == "after the pause")


def check_flood(home: HomeAssistant, _: Robot) -> None:
    home.set_paused(True)
    for number in range(15):
        home.act("notify.send_message", entity_id="notify.anna", message=f"flood {number}")
    home.wait_for("sensor.anna_pending", "15")
    assert home.say_and_wait("too much") == {
        "state": "REJECTED", "reason": "queue_full",
        "message": "not spoken: 15 goals of remote clients are already waiting, 15 of them from homeassistant",
    }  # fmt: skip
    home.wait_for("sensor.anna_last_result", "REJECTED")
    home.cancel()
    home.wait_for("sensor.anna_pending", "0")
    home.set_paused(False)


def check_automation(home: HomeAssistant, robot: Robot) -> None:
    home.request("/api/states/binary_sensor.door", {"state": "off"})
    home.set_paused(True)
    home.request("/api/states/binary_sensor.door", {"state": "on"})
    home.wait_for("sensor.anna_pending", "1")
    home.cancel()
    home.set_paused(False)
    home.wait(lambda: robot.spoken[-1] == "the door is open")


def check_absence(home: HomeAssistant, robot: Robot) -> None:
    before = home.state("event.anna_sentence_ended")
    robot.bridge.kill()
    for entity in ("notify.anna", "sensor.anna_state", "event.anna_sentence_ended", "switch.anna_paused"):
        home.wait_for(entity, "unavailable")
    robot.bridge.start()
    home.wait_for("sensor.anna_state", "idle")
    assert home.state("event.anna_sentence_ended") == before  # no new event
    assert home.say_and_wait("I am back")["state"] == "SUCCEEDED"


def check_log(home: HomeAssistant, _: Robot) -> None:
    parts = ("components.mqtt", "components.script", "components.automation")
    lines = home.log.read_text("utf-8").splitlines()
    noted = [line for line in lines if re.search(r" (WARNING|ERROR) ", line) and any(part in line for part in parts)]
    assert not noted, "\n".join(noted)


CHECKS: dict[str, Callable[[HomeAssistant, Robot], None]] = {
    "the device has its entities": check_device,
    "a message is spoken, with its special characters": check_notify,
    "10 scripts at once get the results of their own goals": check_own_result,
    "a message interrupts": check_interrupt,
    "a sentence that continues after an interjection counts as speaking": check_interjection,
    "the switch pauses and resumes, and shows the pauses of others": check_pause,
    "a lost announcement is shown, and its script gets the reason": check_flood,
    "the documented automation reacts to its result": check_automation,
    "a robot that goes away is unavailable, and fires no event when it is back": check_absence,
    "Home Assistant's log has no warnings about MQTT, the script and the automation": check_log,
}


def install(python: str | None, directory: Path) -> Path:
    """Install Home Assistant into an environment, unless it is there. Return its program.

    Raises:
        NotInstallableError: there is no suitable Python, or the installation fails.
    """
    program, marker = directory / "bin" / "hass", directory / f"homeassistant-{VERSION}"
    if marker.exists():
        return program
    wanted = ".".join(map(str, OLDEST_PYTHON))
    code = f"import sys; sys.exit(sys.version_info[:2] < {OLDEST_PYTHON})"
    for each in filter(None, map(shutil.which, [python] if python else [sys.executable, "python3.13", "python3.14"])):
        if subprocess.run([each, "-c", code], capture_output=True, check=False).returncode == 0:
            break
    else:
        raise NotInstallableError(f"it needs Python {wanted} or later; choose one with --python")
    print(f"installing Home Assistant {VERSION} into {directory}", file=sys.stderr)
    for command in (
        [each, "-m", "venv", str(directory)],
        [str(directory / "bin" / "pip"), "install", "-q", f"homeassistant=={VERSION}", "paho-mqtt==2.1.0"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise NotInstallableError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    marker.touch()
    return program


@contextlib.contextmanager
def running(program: Path) -> Iterator[tuple[HomeAssistant, Robot]]:
    """Run Home Assistant with a broker and the robot anna."""
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker())
        talk = stack.enter_context(Talk(scripted=True))
        bridge = stack.enter_context(Bridge(talk, broker, "anna", "--homeassistant"))
        bridge.await_online()
        directory = Path(stack.enter_context(short_directory("ha-")))
        home = HomeAssistant(program, directory, stack.enter_context(Port()).number)
        stack.callback(home.close)
        home.set_up(broker)
        yield home, Robot(talk, broker, bridge)


def main() -> int:
    parser = argparse.ArgumentParser("python -m tests.tools.homeassistant", description=__doc__)
    parser.add_argument("--python", metavar="PROGRAM", help="a Python 3.13 or later for Home Assistant")
    default = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "talk-homeassistant"
    parser.add_argument("--environment", type=Path, default=default, metavar="DIR", help="default: %(default)s")
    options = parser.parse_args()
    try:
        program = install(options.python, options.environment)
    except NotInstallableError as error:
        print(f"Home Assistant can't be installed here: {error}", file=sys.stderr)
        return NOT_INSTALLED
    failed = 0
    with running(program) as (home, robot):
        for name, check in CHECKS.items():
            try:
                check(home, robot)
                print(f"ok     {name}", flush=True)
            except (AssertionError, OSError, LookupError):
                failed += 1
                print(f"FAILED {name}\n{traceback.format_exc()}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
