"""Shell commands that install packages into this process's Python environment.

Error messages show these commands if a package is missing.
"""

from __future__ import annotations

import os
import sys

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Sequence

#: Whether this process is 64-bit. Neither onnxruntime nor espeakng-loader has a 32-bit build. `platform.machine()`
#: doesn't help, because it returns the kernel's architecture, and a 64-bit kernel can run a 32-bit system.
IS_64_BIT = sys.maxsize > 2**32

#: The packages that neural voices need.
NEURAL_PACKAGES = ("onnxruntime", "numpy")


@frozen
class Environment:
    """The properties of a Python environment that matter for installing packages."""

    python: str  # path to the interpreter
    pipx: str | None = None  # directory of the environment, if pipx created it
    user_home: str = ""
    has_pip: bool = True
    made_by_uv: bool = False
    externally_managed: bool = False  # whether pip needs --break-system-packages
    needs_sudo: bool = False


def command(*packages: str, reinstall: bool = False) -> str:
    """Return the shell command that installs packages into this process's Python environment.

    Args:
        packages: names of the packages.
        reinstall: whether to reinstall packages that are already installed.
    """
    return command_for(_inspect_environment(), packages, reinstall=reinstall)


def neural_command(*more: str, reinstall: bool = False) -> str:
    """Return the shell command that installs the packages for neural voices, or a reason why they can't be installed.

    On a 32-bit system, there is none.
    """
    if not IS_64_BIT:
        return "neural voices need a 64-bit system; use an espeak voice, such as en"
    return command(*NEURAL_PACKAGES, *more, reinstall=reinstall)


def espeak_command() -> str:
    """Return a text with one or two alternative shell commands that install libespeak-ng."""
    package = "sudo apt-get install -y libespeak-ng1"
    return f"{package}, or {command('espeakng-loader')}" if IS_64_BIT else package


def command_for(environment: Environment, packages: Sequence[str], *, reinstall: bool = False) -> str:
    """Return the shell command that installs packages into the given environment."""
    from shlex import join, quote

    sudo = "sudo " if environment.needs_sudo else ""
    names = join(packages)
    python = quote(environment.python)
    if environment.pipx is not None:
        home = os.path.dirname(os.path.dirname(environment.pipx))
        named = "" if home.startswith(f"{environment.user_home}/") else f"PIPX_HOME={quote(home)} "
        force = "--force " if reinstall else ""
        return f"{sudo}{named}pipx inject {force}{quote(os.path.basename(environment.pipx))} {names}"
    if environment.made_by_uv and not environment.has_pip:
        return f"{sudo}uv pip install {'--reinstall ' if reinstall else ''}--python {python} {names}"
    names = f"--force-reinstall {names}" if reinstall else names
    managed = environment.externally_managed
    pip = f"{sudo}{python} -m pip install {'--break-system-packages ' if managed else ''}{names}"
    get_pip = "sudo apt-get install -y python3-pip" if managed else f"{sudo}{python} -m ensurepip"
    return pip if environment.has_pip else f"{get_pip} && {pip}"


def _inspect_environment() -> Environment:
    """Return the properties of the Python environment that this process runs in."""
    from importlib.util import find_spec

    is_virtual = sys.prefix != sys.base_prefix
    # Outside a virtual environment, the owner of this file can install packages without sudo, because the file is in
    # site-packages or in a checkout.
    owner = os.stat(sys.prefix if is_virtual else os.path.dirname(__file__)).st_uid
    return Environment(
        python=sys.executable or "python3",
        pipx=sys.prefix if os.path.exists(os.path.join(sys.prefix, "pipx_metadata.json")) else None,
        user_home=os.path.expanduser("~"),
        has_pip=find_spec("pip") is not None,
        made_by_uv=_is_made_by_uv(),
        externally_managed=not is_virtual
        and os.path.exists(os.path.join(os.path.dirname(os.__file__), "EXTERNALLY-MANAGED")),
        needs_sudo=os.geteuid() not in {0, owner},
    )


def _is_made_by_uv() -> bool:
    """Return whether uv made this virtual environment."""
    try:
        with open(os.path.join(sys.prefix, "pyvenv.cfg"), encoding="utf-8") as file:
            return any(line.startswith("uv =") for line in file)
    except FileNotFoundError:  # Python doesn't run in a virtual environment
        return False
