"""The examples of containers, services and troubleshooting, with stand-ins that keep the machine as it is."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

from tests.readme.blocks import block, runs

if TYPE_CHECKING:
    from tests.readme.shell import Shell
    from tests.support.processes import Talk

#: `docker exec talk COMMAND`, here.
_DOCKER = """case $1 in exec) shift 2; exec "$@" ;; *) exit 0 ;; esac"""
#: `sudo tee FILE` writes into the directory of the test.
_SUDO = """case $1 in tee) mkdir -p system; exec tee "system/${2##*/}" ;; *) exit 0 ;; esac"""


@runs("In a container")
def test_dockerfile() -> None:
    lines = block("In a container").splitlines()
    assert [each.split()[0] for each in lines] == ["FROM", "RUN", "COPY", "RUN", "CMD"]
    assert json.loads(lines[-1].removeprefix("CMD")) == ["talk", "serve"]


@runs("In a container #2", "In a container #3")
def test_containers(speaking: Talk, shell: Shell) -> None:
    shell.stand_in("docker", _DOCKER)
    shell.stand_in("getent", "echo audio:x:29:")
    done = shell.run(block("In a container #2"))
    assert done.returncode == 0, done
    build, run, _, _ = shell.calls("docker")
    assert build == ["build", "-t", "talk", "."]
    assert run[-5:] == ["--device", "/dev/snd", "--group-add", "29", "talk"]
    assert speaking.watcher.goals()
    assert shell.run(block("In a container #3"), XDG_RUNTIME_DIR="/run/user/1000").returncode == 0
    run = shell.calls("docker")[-1]
    assert run[run.index("-v") + 1] == "/run/user/1000/pulse/native:/tmp/pulse.sock"
    assert run[-5:] == ["talk", "talk", "serve", "--player", "pacat"]


@runs("As a service")
def test_services(shell: Shell) -> None:
    for name, then in {"sudo": _SUDO, "systemctl": "exit 0", "loginctl": "exit 0"}.items():
        shell.stand_in(name, then)
    done = shell.run(block("As a service"))
    assert done.returncode == 0, done
    units = {".config/systemd/user/talk.service": "--rate", "system/talk.service": "--socket-mode"}
    for unit, option in units.items():
        assert re.search(f"(?m)^ExecStart=.* serve {option}", (shell.directory / unit).read_text(encoding="utf-8"))
    assert shell.calls("systemctl") == [["--user", "daemon-reload"], ["--user", "enable", "--now", "talk"]]
    assert shell.calls("loginctl") == [["enable-linger"]]
    called = [" ".join(each) for each in shell.calls("sudo")[1:]]
    assert called == ["systemctl daemon-reload", "systemctl enable --now talk", "usermod -aG audio NAME"]


@runs("Troubleshooting", "Another talk")
def test_troubleshooting(shell: Shell) -> None:
    shell.ssh()
    done = shell.run(block("Troubleshooting"))
    assert done.returncode == 0, done
    assert done.stdout.endswith("the robot is mute\n")
    assert done.stdout.count("it keeps the time and makes no sound") == 2
    path, version = shell.run(block("Another talk")).stdout.splitlines()
    assert (path, version.split()[0]) == (f"{shell.directory}/bin/talk", "talk")
