"""The README's installation commands, with the real pip and pipx, in a copy of this checkout.

Stand-ins protect the machine from changes: apt-get does nothing, and sudo writes into a directory of the test instead
of `/opt` and `/usr/local`.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import wave
from typing import TYPE_CHECKING

import numpy as np
import pytest

from talkcli.install import NEURAL_PACKAGES
from tests.readme.blocks import block, commands, runs
from tests.readme.shell import Shell
from tests.support.compare import assert_heard
from tests.support.documents import README, ROOT
from tests.support.real_voice import REAL_PACKAGE, REAL_VOICE
from tests.support.reference import Sentence, render
from tests.support.surroundings import clean_environment, needs, needs_packages, short_directory

if TYPE_CHECKING:
    import pathlib
    from collections.abc import Iterator


#: Time limit for an example. pip downloads packages, perhaps over a slow network.
LIMIT = 90.0
#: The variables that pip needs to connect to its package index.
_OF_PIP = re.compile("(?i)PIP_(CERT|CONFIG|.*INDEX|FIND|TRUST|DEFAULT).*|.*_proxy|SSL_CERT_FILE|REQUESTS_CA_BUNDLE")
#: Files of a checkout that a clone doesn't have.
_GENERATED_FILES = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", ".hypothesis", "dist", "build")
_SUDO = """system=SYSTEM
for word in "$@"; do
    case $word in /opt/* | /usr/local/*) word=$system$word ;; esac
    set -- "$@" "$word"
    shift
done
exec "$@"
"""
#: Speaks only with the given voice once the server runs, prints the goal, and stops the server.
_SPEAK = (
    'id=$(talk --connect-timeout 20 say --wait --voice-only "talk is ready") && talk --json status "$id"; code=$?; '
    "kill $!; wait $!; exit $code"
)


@pytest.fixture
def fresh_shell(tmp_path: pathlib.Path) -> Iterator[Shell]:
    """A shell with a fresh checkout in an empty HOME."""
    home = tmp_path / "home"
    home.mkdir()
    (home / ".hushlogin").touch()  # prevents the first-login message of Ubuntu's bash
    shutil.copytree(ROOT, home / "talk", ignore=_GENERATED_FILES, symlinks=True)
    with short_directory() as directory:
        env = clean_environment(str(home), _settings_of_pip()) | {"TALK_SOCKET": f"{directory}/s", "SHELL": "/bin/bash"}
        env.pop("PYTHONPATH", None)  # it would make this checkout importable
        with contextlib.closing(Shell(home, env, talk=False)) as shell:
            shell.program("python3", f'exec {sys.executable} "$@"')
            yield shell
    shutil.rmtree(home)  # the environments are large, and pytest keeps three runs


def _settings_of_pip() -> dict[str, str]:
    settings = {name: value for name, value in os.environ.items() if _OF_PIP.fullmatch(name)}
    for path in ("~/.config/pip/pip.conf", "~/.pip/pip.conf"):  # the shell has another HOME
        if os.path.exists(os.path.expanduser(path)):
            settings.setdefault("PIP_CONFIG_FILE", os.path.expanduser(path))
    return settings


def _needs_package_index(shell: Shell, *packages: str) -> None:
    """Skip the test if pip can't connect to a package index. In CI, fail."""
    made = shell.run("python3 -m venv registry", limit=LIMIT)
    assert made.returncode == 0, made
    pip = ["registry/bin/pip", "--timeout", "10", "--retries", "1", "download", "-q", "--no-deps", "-d", "downloaded"]
    done = shell.run(" ".join([*pip, *packages]), limit=LIMIT)
    if done.returncode == 0:
        return
    reason = f"pip can't connect to a package index: {(done.stderr.strip().splitlines() or ['no message'])[-1]}"
    if os.environ.get("CI"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


@pytest.mark.slow
@runs("Start")
def test_the_first_command_speaks(fresh_shell: Shell) -> None:
    """The test starts from a fresh checkout. `kill %1` ends the server."""
    needs("bash")
    _needs_package_index(fresh_shell, "click")
    done = fresh_shell.run(
        'exec bash -c "$1"',  # sh has no job control in a script
        f"cd talk\n{block('Start')}code=$?\ntalk status; kill %1; wait %1; exit $code",
        limit=LIMIT,
        TALK_PLAYER="null",
    )
    assert done.returncode == 0, done
    assert f"ready on {fresh_shell.env['TALK_SOCKET']}" in done.stderr
    assert re.search(r"SUCCEEDED .*talk is ready", done.stdout), done
    assert not os.path.exists(fresh_shell.env["TALK_SOCKET"])


@runs("Start #2")
def test_the_first_command_can_write_a_file_instead(tmp_path: pathlib.Path) -> None:
    command = block("Start #2")
    assert command.replace(" --player file:ready.wav", "") == block("Start")
    with short_directory() as place:
        env = clean_environment(place, {"TALK_SOCKET": f"{place}/s", "PULSE_SERVER": "", "XDG_CONFIG_HOME": place})
        with contextlib.closing(Shell(tmp_path, env)) as shell:
            shell.stand_in("python3", "mkdir -p .venv/bin && : > .venv/bin/activate")
            shell.stand_in("pip")
            done = shell.run(f"{command}code=$?; kill $!; wait $!; exit $code")
    assert (done.returncode, shell.calls("pip")) == (0, [["install", "."]]), done
    assert "no sound device" not in done.stderr
    with wave.open(f"{tmp_path}/ready.wav") as file:
        samples = np.frombuffer(file.readframes(file.getnframes()), np.int16)
    assert_heard(samples, render([Sentence("talk is ready")]))


@pytest.mark.slow
@runs("Install: For one user", "Install: For all users")
def test_talk_can_be_installed_for_one_user_or_all_users(fresh_shell: Shell) -> None:
    """The error message for a missing package contains the command that installs it."""
    needs("bash")
    _needs_package_index(fresh_shell, "pipx")
    fresh_shell.stand_in("apt-get")
    fresh_shell.stand_in("sudo", _SUDO.replace("SYSTEM", f"{fresh_shell.directory}/system"))
    for path in ("opt", "usr/local/bin"):
        (fresh_shell.directory / "system" / path).mkdir(parents=True)
    done = fresh_shell.run("registry/bin/pip install -q pipx && ln -s ../registry/bin/pipx bin/pipx", limit=LIMIT)
    assert done.returncode == 0, done
    for users, talk in (("one user", ".local/bin/talk"), ("all users", "system/usr/local/bin/talk")):
        example = block(f"Install: For {users}")
        done = fresh_shell.run(f"set -e; cd talk\n{example}", limit=LIMIT)
        assert done.returncode == 0, done
        assert fresh_shell.run(f"{fresh_shell.directory}/{talk} --version").stdout.startswith("talk ")
    assert (
        fresh_shell.run(f"{fresh_shell.directory}/{talk} say -o hello.wav -- hello && test -s hello.wav").returncode
        == 0
    )
    result = fresh_shell.run("PATH=/usr/bin:/bin bash -ic 'type -ap talk' 2> bash.log")
    talk = f"{fresh_shell.directory}/.local/bin/talk"
    assert talk in result.stdout.splitlines(), result  # an older `talk` may precede it
    for command in (f"say -o said.wav --voice {REAL_VOICE} hello", "--robot anna status"):
        failed = fresh_shell.run(f"{talk} {command}")
        advice = re.search(r"\S+ inject talkcli .*", failed.stderr)
        assert advice, failed
        assert f"`{advice[0]}`" in README.text
        assert fresh_shell.run(advice[0], limit=LIMIT).returncode == 0
        assert advice[0] not in fresh_shell.run(f"{talk} {command}").stderr
    assert fresh_shell.run("test -s said.wav").returncode == 0


@runs("Start #3")
def test_ci_runs_the_readmes_test_command() -> None:
    """CI reads the command from the README, and runs the slow tests after it."""
    needs("bash")
    ci = (ROOT / ".ci/run").read_text(encoding="utf-8")
    finds = next(line for line in ci.splitlines() if line.startswith("test_command="))
    done = subprocess.run(["bash", "-c", f'{finds}; echo "$test_command"'], cwd=ROOT, capture_output=True, check=True)
    assert done.stdout.decode() == block("Start #3")
    steps = [line for line in ci.splitlines() if line and not line.startswith("step ")]
    assert steps[-2:] == ['eval "$test_command"', '"$bin/pytest" -n 4 -m slow']


@runs("Choose a voice: Neural voices")
def test_two_commands_set_up_a_neural_voice(tmp_path: pathlib.Path) -> None:
    needs_packages(*NEURAL_PACKAGES, REAL_PACKAGE)
    install, serve = commands("Choose a voice: Neural voices")
    assert install.split()[-1].replace("-", "_") == REAL_PACKAGE
    with short_directory() as place:
        env = clean_environment(place, {"TALK_SOCKET": f"{place}/s", "TALK_PLAYER": f"file:{place}/said.wav"})
        with contextlib.closing(Shell(tmp_path, env)) as shell:
            shell.stand_in("pip")
            done = shell.run(f"{install}\n{serve} & {_SPEAK}")
    assert (done.returncode, shell.calls("pip")) == (0, [["install", ".[neural]", install.split()[-1]]]), done
    assert REAL_VOICE in done.stdout
