"""What a serving host fetches of its machine; it proves by a key that it may."""

from __future__ import annotations

from fastapi import APIRouter, Request
from starlette.responses import PlainTextResponse, Response

from dtwin.serve.delivery import MAC, NONCE, answer, delivery, question, read_key, same
from dtwin.workbench._bench import Here

router = APIRouter()


@router.get("/delivery/{machine}", include_in_schema=False)
def deliver(request: Request, bench: Here, machine: str) -> Response:
    """Return bundles and pointers of a machine, signed for this question alone."""
    home = bench.home
    key, nonce = read_key(home), request.headers.get(NONCE, "")
    if key is None or not same(request.headers.get(MAC, ""), question(key, nonce, machine)):
        return PlainTextResponse("refused: this asks without the key of this home\n", 403)
    content = delivery(home, machine)
    return Response(content, media_type="application/json", headers={MAC: answer(key, nonce, content)})
