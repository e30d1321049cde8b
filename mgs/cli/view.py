"""`mgs view`: a run or a PLY in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def view(
    subject: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|SPLATS.ply", help="Folder that `mgs nbv` wrote, or a 3DGS PLY."
        ),
    ],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to serve on; 0: any free one.")
    ] = 8080,
    host: Annotated[
        str,
        typer.Option(
            help="Address to serve on. Any other than 127.0.0.1 can be reached by others."
        ),
    ] = "127.0.0.1",
    follow: Annotated[
        bool, typer.Option("--follow", help="Show every new step of a run that goes on.")
    ] = False,
) -> None:
    """Show a run or a model in the browser, to be turned by mouse, keyboard or touch: Gaussians,
    mesh and cameras.

    While the camera moves, the browser draws the Gaussians, without view-dependent colour. While it
    rests, the kernel's image is shown. Layers: colour, alpha, depth, and of a run information,
    uncertainty, and what is unobserved. A click on a camera shows its image and its numbers. Ctrl-C
    ends it.
    """
    import time

    from mgs import runtime
    from mgs.view.server import Viewer

    runtime.start()
    viewer = Viewer(subject, host, port, follow)
    try:
        token = viewer.access.token
        if token:
            typer.echo(f"--host {host}: whoever has the address below, with its token, can look")
        shown = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        query = f"/?token={token}" if token else ""
        typer.echo(f"open http://{shown}:{viewer.port}{query} in a browser; Ctrl-C ends it")
        while True:
            viewer.tick()
            time.sleep(0.05)
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
