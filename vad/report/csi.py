"""CSI logs for people: what is in one, and how a recording goes."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from vad.csi.summary import LogSummary, Spread
from vad.health import Health
from vad.report.words import printable

_MANY_SENDERS = 12


def log_table(name: str, log: LogSummary) -> RenderableType:
    """A log's summary as rows of name and value under the file's name."""
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")

    def row(key: str, value: str) -> None:
        table.add_row(key, Text(value))

    row("packets", f"{log.packets:,}" + _counts(log.shapes, ": "))
    if log.counter_still and log.packets > 1:
        row("time", "the NIC's counter never advances: rate and intervals are not known")
    elif log.span_s is not None and log.rate_per_s is not None:
        row("time", f"{log.span_s:.3f} s, {log.rate_per_s:.1f} packets/s")
    if log.interval_ms is not None:
        row("intervals", _spread(log.interval_ms, "ms", 3))
    row("gaps", f"{log.gaps} in bfee_count, {log.lost} packets missing there")
    for i, sender in enumerate(log.senders[:_MANY_SENDERS]):
        rate = "" if sender.rate_per_s is None else f", {sender.rate_per_s:.1f}/s"
        row("" if i else "senders", f"{sender.mac or 'unknown'}: {sender.packets:,}{rate}")
    if len(log.senders) > _MANY_SENDERS:
        row("", f"and {len(log.senders) - _MANY_SENDERS} more")
    if log.unattributed:
        row("unknown because", _counts(log.unattributed))
    for antenna, spread in log.rssi_db.items():
        row(f"RSSI {antenna}", _spread(spread, "dB"))
    noise = "unknown" if log.noise_dbm is None else _spread(log.noise_dbm, "dBm")
    row("noise", noise if log.noise_known in (0.0, 1.0) else f"{noise} (known for {log.noise_known:.0%})")
    if log.agc_db is not None:
        row("AGC", _spread(log.agc_db, "dB"))
    row("records", _counts(log.records) or "none")
    if log.bad:
        row("refused records", _counts(log.bad))
    row("bytes", f"{log.n_bytes:,}")
    if log.truncated_bytes:
        row("truncated", f"{log.truncated_bytes} bytes of an incomplete record at the end")
    return Group(Text(printable(name), style="bold"), table)


def recording_line(
    path: str, packets: int, n_bytes: int, seconds: float, rate_per_s: float, source: Health
) -> Text:
    """How a recording goes, in one line."""
    line = Text(
        f"{printable(path)}: {packets:,} packets, {n_bytes / 1e6:.1f} MB, {seconds:.0f} s, {rate_per_s:.0f}/s"
    )
    lost = source.counters["dropped"]
    if lost:
        line.append(f", {lost:,} lost", "bold red")
    if source.state != "ok":
        line.append(f"  {printable(source.detail)}", "yellow")
    return line


def _spread(spread: Spread, unit: str, digits: int = 0) -> str:
    low, middle, high = (f"{v:.{digits}f}" for v in (spread.lowest, spread.median, spread.highest))
    return f"{middle} {unit} ({low} to {high})"


def _counts(counts: dict[str, int], before: str = "") -> str:
    told = ", ".join(f"{n:,} {name}" for name, n in counts.items())
    return before + told if told else ""
