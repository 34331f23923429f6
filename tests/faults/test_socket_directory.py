"""The usual place under the temporary directory has a name that other users can guess, and may make first."""

from __future__ import annotations

import os
import stat
import sys
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import SERVE, TALK, environment, run, serving

if TYPE_CHECKING:
    from collections.abc import Callable

NOBODY = 65534
pytestmark = [
    pytest.mark.skipif(sys.platform == "darwin", reason="the place there is in the user's home"),
    pytest.mark.skipif(os.path.isdir(f"/run/user/{os.getuid()}"), reason="this user has a runtime directory"),
]


@pytest.fixture(autouse=True)
def _as_tmp(home: str) -> None:
    os.chmod(home, 0o1777)


def place(home: str) -> str:
    return f"{home}/runtime-{os.getuid()}"


def link(home: str) -> None:
    os.mkdir(f"{home}/elsewhere", 0o700)
    os.symlink("elsewhere", place(home))


def link_inside(home: str) -> None:
    link(home)
    os.unlink(place(home))
    os.mkdir(place(home), 0o700)
    os.symlink("../elsewhere", f"{place(home)}/talk")


def open_inside(home: str) -> None:
    os.mkdir(place(home), 0o700)
    os.mkdir(f"{place(home)}/talk")
    os.chmod(f"{place(home)}/talk", 0o777)


def open_to_all(home: str) -> None:
    open_inside(home)
    os.chmod(place(home), 0o777)


def a_file(home: str) -> None:
    with open(place(home), "w", encoding="utf-8"):
        pass


@pytest.mark.parametrize(
    "fault", [link, link_inside, open_to_all, open_inside, a_file], ids=lambda each: str(each.__name__)
)
def test_place_that_somebody_prepared_is_refused_with_the_reason(home: str, fault: Callable[[str], None]) -> None:
    fault(home)
    done = run(SERVE, environment(home))
    assert (done.code, done.out) == (11, ""), done
    assert place(home) in done.err
    assert "Traceback" not in done.err
    assert not os.path.exists(f"{home}/elsewhere") or os.listdir(f"{home}/elsewhere") == []


@pytest.mark.skipif(os.getuid() != 0, reason="only root can make what is another user's")
@pytest.mark.parametrize("theirs", [["talk"], [""]], ids=["inside", "whole"])
def test_place_that_another_user_made_is_refused(home: str, theirs: list[str]) -> None:
    for name in theirs:
        os.makedirs(f"{place(home)}/{name}", 0o700)
        os.chown(f"{place(home)}/{name}", NOBODY, NOBODY)
    done = run(SERVE, environment(home))
    assert (done.code, done.out) == (11, ""), done
    assert place(home) in done.err


@pytest.mark.usefixtures("nobody_serves")
def test_place_that_is_made_by_the_server_is_nobody_else_s(home: str) -> None:
    env = environment(home)
    with serving(env, command=["sh", "-c", 'umask 0; exec "$@"', "sh", *SERVE]):
        for path in (place(home), f"{place(home)}/talk"):
            assert stat.S_IMODE(os.lstat(path).st_mode) == 0o700
            assert os.lstat(path).st_uid == os.getuid()
        assert run([*TALK, "status"], env).code == 0
