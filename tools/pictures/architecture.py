"""``docs/images/architecture.svg``: the way of an episode, of a batch and of an action through the rooms."""

from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise
from xml.sax.saxutils import escape

Box = tuple[str, str]
"""What happens, and where."""

EPISODE: Sequence[Sequence[Box]] = (
    (("seed of a task", "pipeline/scheduling"), ("recording", "pipeline/scheduling")),
    (("expert acts", "sim/recorder"), ("streams, one clock", "recordings")),
    (("cloud", "perception/observer"),),
    (("query points", "perception/queries"),),
    (("exact tracks", "sim/exact_tracks"), ("track and lift", "tracking")),
    (("accept or reject", "pipeline/stages"),),
    (("shard, receipt", "storage"),),
)
BATCH: Sequence[Sequence[Box]] = (
    (("dataset", "storage/dataset"),),
    (("replay buffer", "data/replay_buffer"),),
    (("windows of a step", "data/window_sampler"),),
    (("batch, moved", "data/batch_builder"),),
    (("encode, denoise", "nets"),),
    (("loss", "policies"),),
    (("step, average", "training/trainer"),),
)
ACTION: Sequence[Sequence[Box]] = (
    (("frame and state", "records"),),
    (("the same cloud", "perception/observer"),),
    (("plan", "policies"),),
    (("action by action", "deployment"),),
    (("episodes", "evaluation"),),
    (("numbers", "benchmark"),),
    (("page, figures", "report, viz"),),
)
LANES = (("one episode", EPISODE, "#2a6fbb"), ("one batch", BATCH, "#c8641b"), ("one action", ACTION, "#2f8f63"))
WIDTH, BOX_WIDTH, BOX_HEIGHT, GAP = 1200, 144, 52, 24
STYLE = """
rect { fill: #fff; stroke-width: 1.5 }
text { fill: #22262c; text-anchor: middle }
.lane { font-size: 15px; font-weight: 600; text-anchor: start }
.title { font-size: 13.5px }
.room { font-size: 10.8px; fill: #6a727d; font-family: ui-monospace, Menlo, DejaVu Sans Mono, monospace }
"""
LEFT = (WIDTH - 7 * BOX_WIDTH - 6 * GAP) / 2


def draw_lane(name: str, columns: Sequence[Sequence[Box]], color: str, top: float) -> Iterator[str]:
    """A lane's title, its boxes, and an arrow from every box of a column to the next."""
    yield f'<text x="{LEFT:g}" y="{top + 18:g}" class="lane" style="fill:{color}">{escape(name)}</text>'
    rows = max(map(len, columns))
    places = [_places(column, k, top, rows) for k, column in enumerate(columns)]
    for here, there in pairwise(places):
        straight = len(here) == len(there) and len(here) > 1
        pairs = zip(here, there, strict=True) if straight else ((a, b) for a in here for b in there)
        for (x, y), (x2, y2) in pairs:
            yield (
                f'<line x1="{x + BOX_WIDTH:g}" y1="{y + BOX_HEIGHT / 2:g}" x2="{x2 - 3:g}" '
                f'y2="{y2 + BOX_HEIGHT / 2:g}" stroke="#8a929c" stroke-width="1.4" marker-end="url(#tip)"/>'
            )
    for column, at in zip(columns, places, strict=True):
        for (title, room), (x, y) in zip(column, at, strict=True):
            yield f'<rect x="{x:g}" y="{y:g}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="7" stroke="{color}"/>'
            yield f'<text x="{x + BOX_WIDTH / 2:g}" y="{y + 22:g}" class="title">{escape(title)}</text>'
            yield f'<text x="{x + BOX_WIDTH / 2:g}" y="{y + 40:g}" class="room">{escape(room)}</text>'


def _places(column: Sequence[Box], index: int, top: float, rows: int) -> list[tuple[float, float]]:
    """Upper left corner of each box of a column, centered in the lane."""
    x, step = LEFT + index * (BOX_WIDTH + GAP), BOX_HEIGHT + 12
    first = top + 32 + (rows - len(column)) * step / 2
    return [(x, first + k * step) for k in range(len(column))]


def height_of(columns: Sequence[Sequence[Box]]) -> float:
    """What a lane takes, with the room below it."""
    return 32 + max(map(len, columns)) * (BOX_HEIGHT + 12) + 18


def picture() -> str:
    """The whole picture as SVG."""
    tops = list(accumulate((height_of(columns) for _, columns, _ in LANES), initial=10))
    height = tops[-1]
    lanes = [part for lane, top in zip(LANES, tops, strict=False) for part in draw_lane(*lane, top=top)]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" role="img" '
            'font-family="system-ui, Helvetica, Arial, DejaVu Sans, sans-serif">',
            "<title>The way of one episode, of one batch and of one action through the rooms</title>",
            f"<style>{STYLE}</style>",
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
            '<path d="M0 0.5 L7 4 L0 7.5 z" fill="#8a929c"/></marker></defs>',
            f'<rect width="{WIDTH}" height="{height:g}" stroke="none"/>',
            *lanes,
            "</svg>\n",
        ]
    )
