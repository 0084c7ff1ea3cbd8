"""How writers of a lake wait for each other: by locks here, not at all on a shared store."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dtwin.atomic import make_folder
from dtwin.bucket import Objects
from dtwin.errors import StoreError
from dtwin.home_file import Bucket
from dtwin.lake._folders import Place
from dtwin.locks import take


@contextmanager
def writing(place: Place, name: str, *, shared: bool = False) -> Iterator[None]:
    """Hold a lock of a lake.

    On a shared store there is none: a commit there is a write with a condition, and who comes second begins anew.
    That the store keeps to conditions is tried instead.

    Raises ``StoreError`` when the lake cannot be written.
    """
    if isinstance(place, Bucket):
        Objects(place).probe()
        yield
        return
    try:
        make_folder(place, private=True)
        handle = (place / name).open("w")
    except OSError as error:
        raise StoreError(
            "the lake cannot be written",
            code="store.write",
            where=str(place),
            got=str(error),
            hint="check free space and permissions; nothing was committed",
        ) from error
    with handle:
        take(handle, shared=shared, wait=True)
        yield
