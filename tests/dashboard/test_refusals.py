"""What a browser says that is no request is refused in one way, and ends nothing."""

from __future__ import annotations

import pytest

from tests.dashboard.serving import at_work, browsing
from tests.dashboard.test_page import make_hub
from tests.outputs.test_hostile_requests import HOSTILE


@pytest.mark.parametrize(
    "text", [*HOSTILE, '{"command":"\\ud800","token":"\\udfff"}', "[]", "x" * 5000]
)
async def test_unknown_input_leaves_the_page_running(text: str) -> None:
    hub = make_hub()
    hub.send_command = lambda *sent: pytest.fail(f"sent {sent}")
    async with at_work(hub, token="s3cret-token") as address, browsing(address) as page:
        await page.connection.send(text)
        await page.until(lambda p: p.answers)
        assert page.answers == [{"ok": False, "text": "not understood"}]
        answer = await page.ask(command="request_fix", token="wrong")
        assert answer == {"ok": False, "text": "refused: wrong token"}
