"""MLflow's server behind a guard: ``python -m flows.mlflow_server --port 5000``.

MLflow itself lets everybody who reaches it delete and overwrite models, and 127.0.0.1 is reached by every user
with an account on this computer. Here it answers who says the secret of ``dtwin up``: a browser that entered with
it, by a cookie; a program by ``MLFLOW_TRACKING_TOKEN``.
"""

from __future__ import annotations

import argparse
import os
import secrets

import uvicorn
from starlette.datastructures import Headers, QueryParams
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from dtwin.config import home
from dtwin.own_address import names_this_computer
from flows.own_pages import ENTER, HOST, asks_from_elsewhere, refuse
from flows.reach import mlflow_token

# A redirect would count as coming from where the address was pressed, and a strict cookie were withheld.
_ENTERED = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>MLflow</title><script>'
    # The first view is the list of models, without MLflow's advertisement, its assistant and its mode for chat programs.
    "for (const [key, value] of Object.entries({'_mlflow_model_registry_promo_modal_dismissed': true, "
    "'mlflow.assistant.fab.autoOpenedOnFirstLoad': true, 'mlflow.workflowType': 'machine_learning'})) "
    "if (localStorage.getItem(`${key}_v1`) === null) localStorage.setItem(`${key}_v1`, JSON.stringify(value));</script>"
    '<meta http-equiv="refresh" content="0; url=/#/models">'
)
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
    """

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self.app, self.token, self.cookie = app, token, f"dtwin_mlflow_{port}"

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
            answer = HTMLResponse(_ENTERED, headers={"Referrer-Policy": "no-referrer", "Cache-Control": "no-store"})
            answer.set_cookie(self.cookie, self.token, httponly=True, samesite="strict", path="/")
            await answer(scope, receive, send)
        elif self._is_right(self._said(headers)):
            await self.app(scope, receive, send)
        else:
            await refuse(_ABSENT, 401, scope, receive, send)

    def _said(self, headers: Headers) -> str:
        in_cookie = cookie_parser(headers.get("cookie", "")).get(self.cookie)
        return in_cookie or headers.get("authorization", "").removeprefix("Bearer ")

    def _is_right(self, said: str) -> bool:
        return secrets.compare_digest(said.encode(), self.token.encode())


def main() -> None:
    """Serve until told to stop."""
    parser = argparse.ArgumentParser(prog="python -m flows.mlflow_server")
    parser.add_argument("--port", type=int, required=True)
    port, where = parser.parse_args().port, home()

    from mlflow.server import constants, handlers

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

    uvicorn.run(Secret(app, mlflow_token(where), port), host=HOST, port=port, log_level="warning")


if __name__ == "__main__":
    main()
