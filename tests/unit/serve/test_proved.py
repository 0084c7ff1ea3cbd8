"""How old a proof is, and what follows when it has expired."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime
from pathlib import Path

import pytest
from bundles import path_bundle

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import save_bundle
from dtwin.serve.interface import Provenance
from dtwin.serve.pointer import machine_folder, renew_proof, resolve, write_pointer
from dtwin.serve.proved import require_proof

NOW = datetime(2026, 11, 22, 12, 0, tzinfo=UTC)


def champion(home: Home, proved: str, valid_days: float) -> Bundle:
    made = path_bundle(provenance=Provenance(evidence="real", valid_days=valid_days))
    path = save_bundle(made, machine_folder("cobot-a", home) / "v3.json")
    write_pointer("cobot-a", home, path, 3, "champion", proved)
    return made


@pytest.mark.parametrize(
    ("proved", "valid_days", "holds"),
    [
        ("2026-11-20T09:00:00+00:00", 0.0, True),
        ("2020-01-01T09:00:00+00:00", 0.0, True),
        ("2026-11-20T09:00:00+00:00", 30.0, True),
        ("2026-10-20T09:00:00+00:00", 30.0, False),
        ("2026-10-20", 30.0, False),
        ("", 30.0, False),
        ("", 0.0, True),
        # A clock that was set back proves nothing.
        ("2027-10-20T09:00:00+00:00", 30.0, False),
    ],
)
def test_a_proof_holds_for_as_long_as_the_bundle_says(
    tmp_path: Path, proved: str, valid_days: float, holds: bool
) -> None:
    home = Home(tmp_path)
    bundle = champion(home, proved, valid_days)
    found = resolve("latest", "cobot-a", home)
    if holds:
        told = require_proof(found, bundle, "refuse", NOW)
        assert proved[:10] in told
        assert "WARNING" not in told
        return
    with pytest.raises(GateRefusal, match="has expired") as refused:
        require_proof(found, bundle, "refuse", NOW)
    assert (refused.value.code, refused.value.exit_code) == ("serve.expired", 3)
    assert "WARNING" in require_proof(found, bundle, "warn", NOW)
    assert "repair on 2026-11-21; unless it came before the proof: dtwin recheck" in require_proof(
        found, bundle, "warn", NOW, "repair on 2026-11-21"
    )


def test_a_new_proof_renews_it_for_that_version_only(tmp_path: Path) -> None:
    home = Home(tmp_path)
    renew_proof("cobot-a", home, 3, NOW.isoformat())
    bundle = champion(home, "2026-01-01T00:00:00+00:00", 30.0)
    renew_proof("cobot-a", home, 2, NOW.isoformat())
    assert resolve("latest", "cobot-a", home).proved.startswith("2026-01")
    renew_proof("cobot-a", home, 3, NOW.isoformat())
    found = resolve("latest", "cobot-a", home)
    assert "last proved 2026-11-22, 0 days ago" in require_proof(found, bundle, "refuse", NOW)


def test_a_bundle_without_an_expiry_is_the_one_of_before(tmp_path: Path) -> None:
    plain = path_bundle()
    assert "valid_days" not in plain.body()["provenance"]
    assert Bundle.from_dict(plain.to_dict()).provenance.valid_days == 0.0
    limited = dataclasses.replace(plain, provenance=Provenance(valid_days=7.0))
    assert Bundle.from_dict(limited.to_dict()).provenance.valid_days == 7.0
    endless = dataclasses.replace(plain, provenance=Provenance(valid_days=1e12)).to_dict()
    with pytest.raises(InputError, match="hold for so long"):
        Bundle.from_dict(endless)
