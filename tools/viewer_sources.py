"""Prints the checksum of everything that the viewer's page is built from, so that a stale page is noticed."""

import hashlib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def source_checksum() -> str:
    """SHA-256 over names and contents of the page's sources, in the order of their names."""
    viewer = ROOT / "viewer"
    names = ["index.html", "package.json", "package-lock.json", "vite.config.js"]
    files = [*(viewer / name for name in names), *viewer.glob("src/**/*"), ROOT / "web" / "gspk.mjs"]
    digest = hashlib.sha256()
    for path in sorted(path for path in files if path.is_file()):
        digest.update(f"{path.relative_to(ROOT).as_posix()}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


if __name__ == "__main__":
    print(source_checksum())
