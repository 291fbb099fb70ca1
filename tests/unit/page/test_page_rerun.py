"""The Rerun viewer through the page: behind its codes, with nothing from elsewhere."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from companion.page.views import rerun_views
from companion.streaming.viewer import screen
from companion.streaming.viewer.web_proxy import free_ports
from tests.support.served_page import ELSEWHERE, ServedPage

READ = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
GRPC = {"content-type": "application/grpc-web+proto", "x-grpc-web": "1"}
NOTHING_ASKED = struct.pack(">BI", 0, 0)
"""An empty message of gRPC-web."""


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServedPage]:
    grpc, web = free_ports(2)
    monkeypatch.setattr(rerun_views, "GRPC_PORT", grpc)
    monkeypatch.setattr(rerun_views, "WEB_PORT", web)
    with ServedPage(tmp_path, '[daemon]\nviewer = "web"\n') as served:
        yield served


@pytest.fixture
def viewer(served: ServedPage) -> Iterator[subprocess.Popen[bytes]]:
    process = screen._start(
        rerun_views.GRPC_PORT, "--serve-web", "--web-viewer-port", str(rerun_views.WEB_PORT)
    )
    yield process
    process.kill()
    process.wait()


def test_without_a_code_nobody_sees_it(served: ServedPage) -> None:
    page = rerun_views.viewer_path()
    assert served.ask("GET", page, peer=ELSEWHERE).status == 303
    assert (
        served.ask("GET", page + "re_viewer.js", peer=ELSEWHERE, headers={"accept": "*/*"}).status
        == 401
    )
    assert served.ask("POST", READ, peer=ELSEWHERE, headers={"accept": "*/*"}).status == 401


def test_a_viewer_that_does_not_run_yet_is_waited_for(served: ServedPage) -> None:
    headers = {"host": "localhost"}
    answer = served.ask("GET", rerun_views.viewer_path(), headers=headers)
    assert answer.status == 202 and 'http-equiv="refresh"' in answer.text
    script = rerun_views.viewer_path() + "re_viewer.js"
    answer = served.ask("GET", script, headers={**headers, "accept": "*/*"})
    assert answer.status == 503 and "daemon.viewer" in answer.text


def test_a_viewer_that_is_not_to_run_is_said(tmp_path: Path) -> None:
    with ServedPage(tmp_path, "") as served:
        answer = served.ask("GET", rerun_views.viewer_path(), headers={"host": "localhost"})
    assert answer.status == 503 and "daemon.viewer" in answer.text
    assert "refresh" not in answer.text


def test_its_page_has_nothing_from_elsewhere(
    served: ServedPage, viewer: subprocess.Popen[bytes]
) -> None:
    headers = {"host": "localhost"}
    answer = served.ask("GET", rerun_views.viewer_path(), headers=headers)
    assert answer.status == 200 and "the_canvas_id" in answer.text
    assert "fonts." not in answer.text
    first = answer.text[answer.text.index("<script") :]
    assert first.startswith(rerun_views.AT_HOME.decode())
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    script = served.ask("GET", rerun_views.viewer_path() + "re_viewer.js", headers=headers)
    assert len(script.body) > 100_000
    assert script.headers["cache-control"] == rerun_views.KEPT


def test_its_stream_comes_through_the_page(
    served: ServedPage, viewer: subprocess.Popen[bytes]
) -> None:
    url = f"http://127.0.0.1:{served.port}{READ}"
    with httpx.stream("POST", url, content=NOTHING_ASKED, headers=GRPC, timeout=20) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"] == GRPC["content-type"]
    assert httpx.post(f"http://127.0.0.1:{served.port}/etc/passwd").status_code == 404


def test_its_client_is_loaded_by_nobody_before_someone_looks() -> None:
    command = "import sys, companion.page.page_process; print('httpx' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True)
    assert (found.stdout, found.stderr) == ("False\n", "")
