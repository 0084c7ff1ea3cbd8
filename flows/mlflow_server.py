"""MLflow's server behind a guard: ``python -m flows.mlflow_server --port 5000``.

MLflow itself lets everybody who reaches it delete and overwrite models, and 127.0.0.1 is reached by every user
with an account on this computer. Here it answers who says the secret of ``dtwin up``: a browser that entered with
it, by a cookie; a program by ``MLFLOW_TRACKING_TOKEN``.
"""

from __future__ import annotations

import argparse
import hmac
import json
import os
import re
import secrets
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import uvicorn
from mlflow.utils.mlflow_tags import MLFLOW_PARENT_RUN_ID
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, QueryParams
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from dtwin.config import home
from dtwin.errors import DtwinError
from dtwin.failures import fault_of
from dtwin.own_address import names_this_computer
from flows.own_pages import ENTER, HOST, asks_from_elsewhere, refuse
from flows.reach import mlflow_token

if TYPE_CHECKING:
    from dtwin.train.registry import Registry

# A redirect would count as coming from where the address was pressed, and a strict cookie were withheld.
_ENTERED = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>MLflow</title><script>'
    "for (const [key, value] of Object.entries(%s)) "
    "if (localStorage.getItem(key) === null) localStorage.setItem(key, JSON.stringify(value));</script>"
    '<meta http-equiv="refresh" content="0; url=/#/models">'
)
# The first view is the list of models, without MLflow's advertisement, its assistant and its mode for chat programs.
_FIRST_VIEW = {
    "_mlflow_model_registry_promo_modal_dismissed_v1": True,
    "mlflow.assistant.fab.autoOpenedOnFirstLoad_v1": True,
    "mlflow.workflowType_v1": "machine_learning",
}
_SHOWN = re.compile(r".*_out\.(r2|rms_um)|latency_p99_us|complexity|rms_(before|after)_um|noise_floor_um")
"""Metrics that have a column in the list of runs: MLflow begins with none."""
_MOST_RUNS, _MOST_COLUMNS = 50, 8
_ABSENT = (
    "the token is missing\n  try: open the address that dtwin up printed; for programs MLFLOW_TRACKING_TOKEN is what "
    "stands after the colon in DTWIN_HOME/prefect-auth"
)


class Secret:
    """An application that answers who says a secret.

    Args:
        app: What is guarded.
        token: The secret.
        port: Part of the cookie's name: cookies do not tell ports apart.
        view: Returns what a browser that enters finds set, by the names under which MLflow's pages keep it.
    """

    def __init__(self, app: ASGIApp, token: str, port: int, view: Callable[[], Mapping[str, object]]) -> None:
        self.app, self.token, self.cookie, self.view = app, token, f"dtwin_mlflow_{port}", view
        # Every server of this computer that the browser asks gets the cookie: the secret, which flows are started by, is not told by it.
        self.entered = hmac.new(token.encode(), b"a browser that entered MLflow", "sha256").hexdigest()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        # That it is alive is no secret.
        if scope["type"] == "lifespan" or scope["path"] == "/health":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        # A link of the workbench leads to the first page, which shows nothing by itself.
        first = scope["path"] == "/"
        if not names_this_computer(headers.get("host")) or (asks_from_elsewhere(headers) and not first):
            await refuse("another site asks, or another name", 403, scope, receive, send)
        elif scope["path"] == ENTER and self._is_right(QueryParams(scope["query_string"]).get("token", "")):
            # A name of a metric that somebody logged ends no script.
            view = json.dumps(await run_in_threadpool(self.view)).replace("<", "\\u003c")
            answer = HTMLResponse(
                _ENTERED % view, headers={"Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}
            )
            answer.set_cookie(self.cookie, self.entered, httponly=True, samesite="strict", path="/")
            await answer(scope, receive, send)
        elif self._is_told(headers):
            await self.app(scope, receive, send)
        else:
            await refuse(_ABSENT, 401, scope, receive, send)

    def _is_told(self, headers: Headers) -> bool:
        in_cookie = cookie_parser(headers.get("cookie", "")).get(self.cookie, "")
        return secrets.compare_digest(in_cookie.encode(), self.entered.encode()) or self._is_right(
            headers.get("authorization", "").removeprefix("Bearer ")
        )

    def _is_right(self, said: str) -> bool:
        return secrets.compare_digest(said.encode(), self.token.encode())


def _first_view(registry: Registry) -> dict[str, object]:
    """Return the first view: in the list of runs, columns of what the newest ones were judged by, and those below the newest one."""
    experiment = registry.experiment()
    runs = registry.client.search_runs([experiment], max_results=_MOST_RUNS)
    names = sorted({name for run in runs for name in run.data.metrics if _SHOWN.fullmatch(name)})
    # What was left out comes first, then what stands there once.
    names = sorted(names, key=lambda name: "_out." not in name)[:_MOST_COLUMNS]
    if not names:
        return dict(_FIRST_VIEW)
    parents = {run.data.tags.get(MLFLOW_PARENT_RUN_ID, "") for run in runs[:1]} - {""}
    shown = {
        "selectedColumns": ["attributes.`User`", *(f"metrics.`{name}`" for name in names)],
        "runsExpanded": dict.fromkeys(parents, True),
    }
    return {**_FIRST_VIEW, f'MLflowLocalStorage-1.1-ExperimentPage-["{experiment}"]-ReactComponentState': shown}


def main() -> None:
    """Serve until told to stop."""
    parser = argparse.ArgumentParser(prog="python -m flows.mlflow_server")
    parser.add_argument("--port", type=int, required=True)
    port, where = parser.parse_args().port, home()

    from mlflow.server import constants, handlers

    from dtwin.train.registry import Registry

    # First: it makes the tables in one step, and a server that was stopped while it made them could never be started again.
    try:
        registry = Registry(where)
    except Exception as error:
        fault = error if isinstance(error, DtwinError) else fault_of(error)
        if fault is None:
            raise
        # dtwin up tells the end of the log.
        sys.exit(fault.render())
    root = "mlflow-artifacts:/"
    # As `mlflow server` tells its workers.
    os.environ |= {
        constants.BACKEND_STORE_URI_ENV_VAR: where.mlflow_uri,
        constants.REGISTRY_STORE_URI_ENV_VAR: where.mlflow_uri,
        constants.ARTIFACT_ROOT_ENV_VAR: root,
        constants.ARTIFACTS_DESTINATION_ENV_VAR: str(where.mlflow_artifacts),
        constants.SERVE_ARTIFACTS_ENV_VAR: "true",
    }
    handlers.initialize_backend_stores(where.mlflow_uri, where.mlflow_uri, root)
    from mlflow.server.fastapi_app import app

    guarded = Secret(app, mlflow_token(where), port, lambda: _first_view(registry))
    uvicorn.run(guarded, host=HOST, port=port, log_level="warning")


if __name__ == "__main__":
    main()
