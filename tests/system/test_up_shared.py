"""``dtwin up`` of a shared home: Prefect and MLflow on a real PostgreSQL, artifacts on a real S3 server behind MLflow's."""

from __future__ import annotations

from pathlib import Path

import psycopg2
import pytest
from mlflow import MlflowClient
from running_servers import running_up, wait_for
from shared_servers import BUCKET, KEYS, running_postgres, running_store

from dtwin.atomic import write_toml
from dtwin.bucket import Objects
from dtwin.config import Home
from dtwin.home_file import HOME_FILE

pytestmark = [pytest.mark.system, pytest.mark.long]


def test_the_servers_keep_everything_at_the_shared_places_and_clients_need_no_keys(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = Home(tmp_path / "home")
    with running_postgres(tmp_path_factory.mktemp("pg") / "server") as database, running_store() as store:
        stated = {
            "store": f"s3://{BUCKET}/up",
            "endpoint": f"http://127.0.0.1:{store}",
            "registry": f"postgresql://dtwin@127.0.0.1:{database.port}/mlflow",
            "flows": f"postgresql://dtwin@127.0.0.1:{database.port}/prefect",
        }
        write_toml(home.root / HOME_FILE, stated, "the settings")
        with monkeypatch.context() as keys:
            for name, value in KEYS.items():
                keys.setenv(name, value)
            found = Objects((home.file.bucket or pytest.fail("no store")) / "artifacts")
            with running_up(home, "--no-schedule") as up:
                for name in KEYS:
                    keys.delenv(name)
                keys.setenv("MLFLOW_TRACKING_TOKEN", up.addresses["mlflow_enter"].rpartition("=")[2])
                client = MlflowClient(up.addresses["mlflow"])
                run = client.create_run(client.create_experiment("by proxy"))
                client.log_text(run.info.run_id, "a text", "said.txt")
                assert [item.path for item in client.list_artifacts(run.info.run_id)] == ["said.txt"]

                def deployed() -> int:
                    with psycopg2.connect(stated["flows"]) as asked, asked.cursor() as cursor:
                        cursor.execute("SELECT count(*) FROM deployment")
                        return int((cursor.fetchone() or (0,))[0])

                assert wait_for(deployed, "no flow came to the shared database")
            for name, value in KEYS.items():
                keys.setenv(name, value)
            [artifact] = [stored for stored in found.list() if stored.name.endswith("said.txt")]
            assert found.read(artifact.name) == b"a text"
        with psycopg2.connect(stated["registry"]) as asked, asked.cursor() as cursor:
            cursor.execute("SELECT count(*) FROM runs WHERE run_uuid = %s", (run.info.run_id,))
            assert cursor.fetchone() == (1,)
    assert not (home.root / "mlflow" / "mlflow.db").exists()
    assert not list(home.prefect.glob("*.db"))
