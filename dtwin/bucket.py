"""Reading and writing a shared store; what it must be able to do is tried before the first write."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timedelta
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from dtwin.errors import InputError, StoreError
from dtwin.home_file import Bucket
from dtwin.processes import interruptible

if TYPE_CHECKING:
    from obstore.store import S3Store

_Answer = TypeVar("_Answer")
# A request is tried again while a store is busy or away, but not for so long that nobody knows what goes on.
_RETRIES, _RETRY_S, _REQUEST_S, _CONNECT_S = 8, 60, 60, 5
_PROBES = "probe"
# By what a server says, or the network: what is wrong, and what to try. The first that fits.
_TOLD = {
    # Without keys in the environment the library asks the machine that it runs on, as in a cloud.
    ("169.254.", "latest/api/token"): (
        "there are no credentials for the shared store",
        "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    ),
    ("RequestTimeTooSkewed",): (
        "the clock of this computer differs from the shared store's",
        "set the clock (chrony, timedatectl)",
    ),
    ("ExpiredToken", "InvalidToken", "TokenRefreshRequired", "InvalidAccessKeyId", "SignatureDoesNotMatch"): (
        "the shared store does not take these credentials: they are wrong or have expired",
        "renew AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN and run this again",
    ),
    ("AccessDenied", "403 Forbidden", "401 Unauthorized"): (
        "the shared store does not let this computer do that",
        "ask who keeps the store for the right to list, read, write and delete below this address",
    ),
    ("NoSuchBucket",): ("the shared store has no such bucket", "make the bucket, or mend store in home.toml"),
}
_AWAY = ("the shared store does not answer", "nothing is half-written; run this again when it is back")


class _Stored(NamedTuple):
    """An object of the store: name below the folder, size, entity tag, and when the store says it was written."""

    name: str
    size: int
    tag: str
    changed: datetime


class Objects:
    """The objects below a folder of a shared store.

    Raises ``InputError`` when the environment asks for writes without conditions.
    """

    def __init__(self, bucket: Bucket) -> None:
        self.bucket = bucket

    def read(self, name: str) -> bytes:
        """Return the content of an object.

        Raises ``FileNotFoundError`` when there is none.
        Raises ``StoreError`` when the store does not answer, or refuses.
        """
        import obstore

        return self._ask(name, lambda: bytes(obstore.get(self._store, name).bytes()), missing=True)

    def tagged(self, name: str) -> tuple[bytes, str]:
        """Return the content of an object and its entity tag; raises as :meth:`read`."""
        import obstore

        def answer() -> tuple[bytes, str]:
            stored = obstore.get(self._store, name)
            return bytes(stored.bytes()), str(stored.meta["e_tag"])

        return self._ask(name, answer, missing=True)

    def has(self, name: str) -> bool:
        """Tell whether there is such an object."""
        import obstore

        try:
            self._ask(name, lambda: obstore.head(self._store, name), missing=True)
        except FileNotFoundError:
            return False
        return True

    def put(self, name: str, data: bytes | memoryview) -> None:
        """Write an object, whole or not at all, whatever is there."""
        import obstore

        self.probe()
        self._ask(name, lambda: obstore.put(self._store, name, bytes(data)))

    def put_new(self, name: str, data: bytes | memoryview) -> str | None:
        """Write an object that is not there, and return its tag; None when it is there."""
        self.probe()
        return self._conditional(name, data, "create")

    def replace(self, name: str, data: bytes | memoryview, tag: str) -> str | None:
        """Write over an object that still has this tag, and return the new one; None when another was faster."""
        self.probe()
        return self._conditional(name, data, {"e_tag": tag})

    def list(self, below: str = "", *, after: str = "") -> list[_Stored]:
        """Return the objects whose names begin with a folder, in order; only those that come after a name."""
        import obstore

        def answer() -> dict[str, Any]:
            rows: dict[str, Any] = {}
            for chunk in obstore.list(self._store, below or None, offset=after or None, chunk_size=1000):
                both = len(rows) + len(chunk)
                rows |= {str(row["path"]): row for row in chunk}
                if len(rows) < both:
                    raise self._repeats(below)
            return rows

        return sorted(
            _Stored(name, int(row["size"]), str(row["e_tag"]), row["last_modified"])
            for name, row in self._ask(below, answer).items()
        )

    def _repeats(self, below: str) -> StoreError:
        return StoreError(
            "the shared store begins its list again before the end",
            code="shared.list",
            where=f"{self.bucket}/{below}",
            got="a name twice",
            allowed="a continuation token that leads on",
            hint="another store or a newer version of it; look whether a proxy on the way keeps old answers",
        )

    def delete(self, names: Sequence[str]) -> None:
        """Delete objects; one that is not there is no mistake."""
        import obstore

        if names:
            self._ask(names[0], lambda: obstore.delete(self._store, list(names)))

    def probe(self) -> None:
        """Try whether the store keeps what commits rest on: it must refuse to write over what is there, or has changed.

        Once in a process for each store.

        Raises ``StoreError`` when it does not refuse, or does not answer.
        """
        _probed(Bucket(self.bucket.url, self.bucket.endpoint), _environment())

    @property
    def _store(self) -> S3Store:
        return _opened(self.bucket, _environment())

    def _conditional(self, name: str, data: bytes | memoryview, mode: Any) -> str | None:
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        def write() -> str | None:
            try:
                return str(obstore.put(self._store, name, bytes(data), mode=mode, use_multipart=False)["e_tag"])
            except (AlreadyExistsError, PreconditionError):
                return None

        return self._ask(name, write)

    def _ask(self, name: str, call: Callable[[], _Answer], *, missing: bool = False) -> _Answer:
        """Return what a call of the library returns, which does not hear Ctrl-C while it waits; see :func:`_told`."""
        with _told(self.bucket, name, missing=missing):
            return interruptible(call)


@lru_cache(maxsize=8)
def _probed(bucket: Bucket, _environment: tuple[tuple[str, str], ...]) -> None:
    objects, name = Objects(bucket), f"{_PROBES}/{uuid.uuid4().hex}"
    first = objects._conditional(name, b"1", "create")
    again = objects._conditional(name, b"2", "create")
    other = objects._conditional(name, b"3", {"e_tag": '"00000000000000000000000000000000"'})
    objects.delete([name])
    kept = {"If-None-Match": again is None, "If-Match": other is None}
    ignored = [header for header, refused in kept.items() if not refused]
    if ignored or first is None:
        raise StoreError(
            "the shared store ignores the condition of a write, so commits of two writers would be lost",
            code="shared.unsafe",
            where=str(bucket),
            got=f"a write with {', '.join(ignored)} that had to be refused was taken",
            allowed="a store, and a way to it, that answers 412 to it",
            hint="another store or a newer version of it; look whether a proxy on the way drops headers",
        )


@lru_cache(maxsize=16)
def _opened(bucket: Bucket, _environment: tuple[tuple[str, str], ...]) -> S3Store:
    from obstore.store import S3Store

    about: dict[str, Any] = {"endpoint": bucket.endpoint} if bucket.endpoint else {}
    with _told(bucket, ""):
        return S3Store(
            bucket.name,
            prefix=bucket.prefix or None,
            conditional_put="etag",
            client_options={
                "allow_http": True,
                "timeout": timedelta(seconds=_REQUEST_S),
                "connect_timeout": timedelta(seconds=_CONNECT_S),
            },
            retry_config={"max_retries": _RETRIES, "retry_timeout": timedelta(seconds=_RETRY_S)},
            **about,
        )


def delta_options(bucket: Bucket) -> dict[str, str]:
    """Return what the library of Delta tables is told of a store, besides the environment.

    Raises ``InputError`` when the environment asks for commits without a condition.
    """
    _environment()
    options = {
        "conditional_put": "etag",
        "aws_allow_http": "true",
        "timeout": f"{_REQUEST_S}s",
        "connect_timeout": f"{_CONNECT_S}s",
        "max_retries": str(_RETRIES),
        "retry_timeout": f"{_RETRY_S}s",
    }
    return options | ({"aws_endpoint_url": bucket.endpoint} if bucket.endpoint else {})


@contextmanager
def _told(bucket: Bucket, name: str, *, missing: bool = False) -> Iterator[None]:
    """Turn what goes wrong at a store into an error that says what, where and what to try.

    ``missing``: whether an object that is not there is an answer: it raises FileNotFoundError.
    """
    from obstore.exceptions import BaseError

    try:
        yield
    except (BaseError, OSError) as error:
        text = str(error)
        if missing and isinstance(error, FileNotFoundError) and "NoSuchBucket" not in text:
            raise
        raise store_error(text, f"{bucket}/{name}" if name else str(bucket)) from error


def store_error(text: str, where: str) -> StoreError:
    """Return the error for what a store, or the way to it, said."""
    known = next((told for signs, told in _TOLD.items() if any(sign in text for sign in signs)), _AWAY)
    return StoreError(known[0], code="shared.store", where=where, got=text.split("\n")[0][:200], hint=known[1])


def is_of_store(text: str) -> bool:
    """Tell whether an error is one of a store, or of the way to it, and not of what it holds."""
    return any(sign in text for sign in ("S3 error", "HTTP", "sending request", "retries"))


def _environment() -> tuple[tuple[str, str], ...]:
    """Return what the environment says of stores: a client is made anew when that changes."""
    settings = {key.upper(): value for key, value in os.environ.items() if key.upper().startswith("AWS_")}
    _require_safe(settings)
    return tuple(sorted(settings.items()))


def _require_safe(environment: Mapping[str, str]) -> None:
    allowed = {"AWS_S3_ALLOW_UNSAFE_RENAME": ("", "0", "false", "no"), "AWS_CONDITIONAL_PUT": ("", "etag")}
    for name, harmless in allowed.items():
        if environment.get(name, "").lower() not in harmless:
            raise InputError(
                "the environment asks for commits without a condition, which lose those of other writers",
                code="shared.unsafe",
                where=name,
                got=environment[name][:40],
                allowed="not set",
                hint=f"unset {name}",
            )
