"""What takes long to make of a model, kept for the next start: its halves, the first as onnxruntime has optimised it.

Files of a directory that nobody but this user can write or read, two for each key, which says of what they were made.
It is never needed: where it can't be had or written, or what is kept was damaged, all is made anew.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import tempfile
import time

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from typing import TypeVar

    from talkcli.engine.child.synthesizers.vits import Buffer

    _T = TypeVar("_T")

#: Bytes that are kept, of eight voices or so; past that the oldest go.
LARGEST = 500_000_000
#: Bytes of a half that are collected to be written at once: no other thread waits for more than that to be copied.
AT_ONCE = 1 << 20
_ENCODER, _DECODER = ".encoder.onnx", ".decoder.onnx"
#: How a directory ends in which one is being written, which takes seconds, and those after which its writer was killed.
_UNFINISHED, _KILLED = ".new", 3600.0
#: The names of what is kept: nothing else is ever removed.
_NAME = re.compile(rf"[0-9a-f]{{64}}-.*(?:{re.escape(_ENCODER)}|{re.escape(_DECODER)}|{re.escape(_UNFINISHED)})")


class Cache:
    """The cache in a directory; OSError where it can't be had. A key begins with 64 hexadecimal digits and a hyphen."""

    def __init__(self, directory: str) -> None:
        os.makedirs(os.path.dirname(directory), exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.mkdir(directory, 0o700)
        status = os.lstat(directory)
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o077:
            raise PermissionError(f"{directory} is not this user's alone: chmod 0700, or remove it")
        self._directory = directory

    def find(self, key: str) -> tuple[str, str] | None:
        """Return the files of both halves, and take note that they are used; None if they are not there."""
        paths = self._place(key, _ENCODER), self._place(key, _DECODER)
        try:
            for each in paths:
                os.utime(each)
        except OSError:
            return None
        return paths

    def keep(self, key: str, encoder: Callable[[str | None], _T], decoder: Iterable[Buffer]) -> _T:
        """Return what `encoder` returns, which writes a file to the path that it is given, and keep both halves.

        `decoder`: what its file consists of.

        Where they can't be kept it is called with None.
        """
        try:
            # A directory of its own: another load of the same model may be at the same point.
            with tempfile.TemporaryDirectory(_UNFINISHED, key, self._directory) as folder:
                made = self._written(key, os.path.join(folder, "half"), encoder, decoder)
        except Exception:  # noqa: BLE001 - of whatever kind: if it was none of writing, it comes again
            made = encoder(None)
        self._shrink()
        return made

    def forget(self, key: str) -> None:
        """Remove what is kept by a key."""
        for each in (_ENCODER, _DECODER):
            with contextlib.suppress(OSError):
                os.unlink(self._place(key, each))

    def _written(self, key: str, unfinished: str, encoder: Callable[[str | None], _T], decoder: Iterable[Buffer]) -> _T:
        with open(unfinished, "wb", AT_ONCE) as file:
            file.writelines(decoder)
        os.replace(unfinished, self._place(key, _DECODER))
        made = encoder(unfinished)
        os.replace(unfinished, self._place(key, _ENCODER))
        return made

    def _place(self, key: str, end: str) -> str:
        return os.path.join(self._directory, key + end)

    def _shrink(self) -> None:
        """Remove the oldest files past the limit, and what writers left that were killed."""
        size = 0
        for changed, path in sorted(self._own(), reverse=True):
            if path.endswith(_UNFINISHED):
                if time.time() - changed > _KILLED:
                    shutil.rmtree(path, ignore_errors=True)
                continue
            with contextlib.suppress(OSError):  # another process was quicker
                size += os.lstat(path).st_size
                if size > LARGEST:
                    os.unlink(path)

    def _own(self) -> Iterator[tuple[float, str]]:
        """Yield what is the cache's own, with the time of its last change or use."""
        with contextlib.suppress(OSError), os.scandir(self._directory) as entries:
            for each in entries:
                if _NAME.fullmatch(each.name):
                    with contextlib.suppress(OSError):
                        yield each.stat(follow_symlinks=False).st_mtime, each.path
