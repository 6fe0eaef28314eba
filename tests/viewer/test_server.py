import http.client
from pathlib import Path

import pytest
from click.testing import CliRunner

from gsplat_tools.cli.inspect import main
from gsplat_tools.formats import save
from tests.clouds import random_cloud
from tests.viewer.conftest import serving


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    save(random_cloud(50, sh_degree=1), path)
    (tmp_path / "secret.txt").write_text("mine", encoding="utf-8")
    return path


def ask(port: int, path: str, host: str | None = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{port}"})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def test_server__has_the_page_and_the_files_that_were_named(scene: Path) -> None:
    with serving(scene) as server:
        port = server.server_address[1]

        assert server.server_address[0] == "127.0.0.1"
        assert ask(port, "/")[0] == 200
        assert ask(port, "/file/0") == (200, scene.read_bytes())
        assert b'"valid": true' in ask(port, "/report/0")[1]


@pytest.mark.parametrize(
    "path", ["/file/1", "/secret.txt", "/../secret.txt", "/file/../../secret.txt", "/file/0/..", "/%2e%2e/"]
)
def test_server__has_nothing_else(scene: Path, path: str) -> None:
    with serving(scene) as server:
        assert ask(server.server_address[1], path) == (404, b"")


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:80"])
def test_server__refuses_other_hosts(scene: Path, host: str) -> None:
    with serving(scene) as server:
        assert ask(server.server_address[1], "/file/0", host) == (403, b"")


def test_view__writes_a_page_and_replaces_none_unasked(scene: Path, tmp_path: Path) -> None:
    page = tmp_path / "view.html"

    first = CliRunner().invoke(main, ["view", str(scene), "--html", str(page)])
    second = CliRunner().invoke(main, ["view", str(scene), "--html", str(page)])

    assert first.exit_code == 0, first.output
    assert page.stat().st_size > 1_000_000
    assert second.exit_code == 1
    assert "--overwrite" in second.stderr


def test_view__says_that_a_port_is_in_use(scene: Path) -> None:
    with serving(scene) as server:
        port = server.server_address[1]
        result = CliRunner().invoke(main, ["view", str(scene), "--no-open", "--port", str(port)])

    assert result.exit_code == 1
    assert f"port {port}" in result.stderr
    assert "--port" in result.stderr


def test_view__of_three_files_is_a_usage_error(scene: Path) -> None:
    assert CliRunner().invoke(main, ["view", *[str(scene)] * 3]).exit_code == 2
