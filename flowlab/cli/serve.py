"""``flowlab serve``."""

import asyncio
import contextlib
import ipaddress
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from flowlab.cli.console import echo, json_option, print_json, warn
from flowlab.cli.heartbeat import PULSE
from flowlab.cli.paths import PATH
from flowlab.errors import MissingLibraryError

if TYPE_CHECKING:
    from flowlab.serving.server import PolicyServer


@click.command()
@click.argument("run", type=PATH)
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on; 0.0.0.0 is every one.")
@click.option("--port", type=click.IntRange(0, 65535), default=8000, show_default=True, help="0 takes a free one.")
@click.option("--task", help="Which to do; else clients must say, if it was trained on several.")
@click.option("--execute", type=click.IntRange(min=1), help="Steps of a plan that clients execute  [as in training].")
@click.option("--device", default="cpu", show_default=True, help="Where plans are made: cpu, cuda, cuda:1.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of a client's first episode.")
@json_option
def serve(
    run: Path, host: str, port: int, task: str | None, execute: int | None, device: str, seed: int, as_json: bool
) -> None:
    """Serve the policy of RUN, or of one of its checkpoints, to a robot on another machine.

    \b
      flowlab serve runs/pour-fdp
      flowlab serve runs/pour-fdp --device cuda --port 9000

    Clients are flowlab.client.RemotePolicy and openpi-client: WebSocket, msgpack. One is served at a time; who reaches
    the port may be it, for there are no passwords. Ends with Ctrl-C. Needs pip install 'flowlab[serve]'.
    """
    try:
        import msgpack  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise MissingLibraryError(
            f"flowlab serve needs websockets and msgpack: pip install 'flowlab[serve]' ({error})"
        ) from error
    from flowlab.policies.trained import weights_at

    weights_at(run)  # which takes no second, as PyTorch does
    from flowlab.serving.contract import ServedPolicy
    from flowlab.serving.episodes import ServedEpisodes
    from flowlab.serving.server import PolicyServer

    served = ServedPolicy.load(run, task, device, seed, execute)
    if not _is_here_only(host):
        warn(f"listening on {host}: whoever reaches this port can use the policy; see docs/serving.md for a tunnel")
    seconds = ServedEpisodes(served).warm_up()

    def listening(url: str) -> None:
        if as_json:
            print_json({"url": url, "plan_s": seconds, **served.metadata()})
        else:
            about = f"{served.network.spec.settings.policy}, {served.training_steps} training steps"
            echo(f"serving {run} ({about}; a plan takes {1000 * seconds:.0f} ms) at {url}; Ctrl-C ends it")

    PULSE.bars += 1  # it waits for clients, and that needs no telling
    asyncio.run(_until_stopped(PolicyServer(served, warn), host, port, listening))
    warn("stopped")


async def _until_stopped(server: "PolicyServer", host: str, port: int, listening: Callable[[str], None]) -> None:
    """Serve until somebody interrupts or ends the process; a second signal ends it at once."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()

    def end() -> None:
        stop.set()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_DFL)

    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(NotImplementedError):  # Windows
            loop.add_signal_handler(number, end)
    await server.run(host, port, stop, listening)


def _is_here_only(host: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
