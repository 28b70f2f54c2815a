"""CSV tables of position fixes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from msg_adapters.fixes import check_size, write_fix

from ...measurements import Fix
from ..conversion import ConversionReport, Record, write_bag
from ..csv_table import CsvOptions, CsvTable, Row
from ..local_frame import LocalFrame
from ..messages import ros_message
from .truth import truth_records


def convert_fixes(
    path: str | Path,
    out: str | Path,
    *,
    options: CsvOptions | None = None,
    truth: str | Path | None = None,
    truth_options: CsvOptions | None = None,
    frame_id: str = 'map',
    origin: tuple[float, ...] | None = None,
    storage: str = 'mcap',
) -> ConversionReport:
    """Convert a CSV of position fixes to the topic ``/fix``.

    Columns: ``stamp``, ``x`` and ``y`` [m] or ``latitude`` and ``longitude`` [deg]; optional ``z``
    (or ``depth``), ``var_x cov_xy var_y`` [m^2], or ``std_x std_y``, or ``std`` [m]. A row with
    empty uncertainties becomes a fix without covariance. Latitudes become metres around `origin`
    (latitude, longitude[, height]), the first good row when None. `truth` is a CSV as in
    `convert_truth`, for the same bag and the same origin.
    """
    table = CsvTable(path, options)
    table.require('stamp')
    frame = LocalFrame(table, origin)
    report = ConversionReport(Path(out))

    def parse(row: Row) -> Fix:
        fix = Fix(
            stamp_ns=row.stamp_ns(),
            position=frame.position(row),
            covariance=_covariance(row),
            frame_id=frame_id,
        )
        check_size(fix)
        return fix

    records: list[Record] = [
        (fix.stamp_ns, '/fix', write_fix(fix, ros_message))
        for _, fix in report.read_rows(table, parse)
    ]
    if truth is not None and records:
        records += truth_records(truth, report, truth_options, frame_id, frame.origin)
    report.notes.update(frame.notes())
    return write_bag(out, records, report, source=Path(path).name, storage=storage)


def _covariance(row: Row) -> np.ndarray | None:
    """The covariance (2, 2) that a row states; None when it is empty, negative or all zero."""
    if row.table.has('var_x', 'var_y'):
        var_x, var_y = row.optional('var_x'), row.optional('var_y')
        cov_xy = row.optional('cov_xy') if row.table.has('cov_xy') else 0.0
    else:
        names = ('std_x', 'std_y') if row.table.has('std_x', 'std_y') else ('std', 'std')
        std_x, std_y = row.optional(names[0]), row.optional(names[1])
        var_x, cov_xy, var_y = std_x * std_x, 0.0, std_y * std_y
        if std_x < 0.0 or std_y < 0.0:
            return None
    if math.isnan(var_x + var_y + cov_xy) or var_x < 0.0 or var_y < 0.0:
        return None
    if var_x == var_y == cov_xy == 0.0:
        return None
    return np.array([[var_x, cov_xy], [cov_xy, var_y]])
