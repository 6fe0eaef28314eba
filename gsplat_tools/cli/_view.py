"""gsplat-inspect view: serve the page, or write it with the files inside."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import click

from gsplat_tools.cli import _options as options
from gsplat_tools.cli._errors import reports_errors


@click.command()
@click.argument("files", nargs=-1, required=True, type=options.EXISTING_FILE, metavar="FILE [FILE2]")
@click.option(
    "--html", "target", type=click.Path(dir_okay=False, path_type=Path), help="Write one page that works offline instead."
)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port to listen on; by default one that is free.")
@click.option("--no-open", is_flag=True, help="Do not open a browser.")
@click.option("--overwrite", is_flag=True, help="Replace the page if it is there.")
@reports_errors
def view(files: tuple[Path, ...], *, target: Path | None, port: int, no_open: bool, overwrite: bool) -> None:
    """Look at a file in the browser, or compare two.

    The page is served on loopback until Ctrl-C. It draws with Spark and plays .sog4d sequences; formats that it does not
    read are handed over in Spark's layout.

    \b
    gsplat-inspect view scene.sog4d
    gsplat-inspect view scene.ply scene.spz --html compare.html
    """  # noqa: D301 - \b keeps click from joining the lines
    from gsplat_tools.formats._atomic import replacing
    from gsplat_tools.viewing.page import offline_page
    from gsplat_tools.viewing.payload import prepare_exhibit
    from gsplat_tools.viewing.server import ViewServer

    if len(files) > 2:
        raise click.UsageError("one file, or two to compare")
    with ExitStack() as keep:
        if target is not None:
            with replacing(target, overwrite=overwrite) as stream:
                stream.write(offline_page(prepare_exhibit(list(files), keep)).encode("utf-8"))
            click.echo(f"{target}: {target.stat().st_size:,} bytes, open it in a browser", err=True)
            return
        server = keep.enter_context(ViewServer(prepare_exhibit(list(files), keep), port))
        click.echo(f"serving {' and '.join(file.name for file in files)} at {server.address} (Ctrl-C ends)", err=True)
        if not no_open:
            click.launch(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            click.echo("ended", err=True)
