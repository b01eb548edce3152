"""The report of a comparison as a table, JSON and JUnit XML."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import asdict
from typing import Any

from motionstereo_cli.errors import MotionStereoError
from motionstereo_cli.evaluation.compare import CompareReport, Difference

#: Class of the test cases.
_CLASS = "motionstereo.compare"


def format_table(report: CompareReport) -> str:
    """Return the differences as a table, or one line if there are none."""
    if not report.differs:
        facts = (f"{output.name} ({output.compared} {output.unit})" for output in report.outputs)
        return f"no difference in {', '.join(facts)}\n"
    rows = [("output", "what", "count", "first", "worst", "found")]
    for output in report.outputs:
        for item in output.differences.values():
            frames = (
                "-" if frame is None else str(frame)
                for frame in (item.first_frame, item.worst_frame)
            )
            rows.append((output.name, item.what, str(item.count), *frames, item.found))  # type: ignore[arg-type]
    widths = [max(map(len, column)) for column in list(zip(*rows, strict=True))[:-1]]
    return "".join(
        f"{name:<{widths[0]}}  {what:<{widths[1]}}  {count:>{widths[2]}}  {first:>{widths[3]}}  "
        f"{worst:>{widths[4]}}  {found}\n"
        for name, what, count, first, worst, found in rows
    )


def format_json(report: CompareReport) -> str:
    """Return the report as JSON; null if a difference is not a number or not in a frame."""

    def known(item: Difference) -> dict[str, Any]:
        return {**asdict(item), "worst": item.worst if math.isfinite(item.worst) else None}

    content = {
        "differs": report.differs,
        "outputs": [
            {
                "name": output.name,
                "unit": output.unit,
                "compared": output.compared,
                "differences": [known(item) for item in output.differences.values()],
            }
            for output in report.outputs
        ],
        "notes": report.notes,
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def format_junit(report: CompareReport) -> str:
    """Return the report as JUnit XML, a test case for each output."""
    failed = [output for output in report.outputs if output.differences]
    suite = _suite(len(report.outputs), failures=len(failed))
    for output in report.outputs:
        case = ET.SubElement(suite, "testcase", classname=_CLASS, name=output.name)
        if output.differences:
            message = f"differs in {', '.join(output.differences)}"
            failure = ET.SubElement(case, "failure", type="difference", message=_xml(message))
            failure.text = _xml(format_table(CompareReport((output,), (), None)))
    return _document(suite)


def junit_of_error(error: MotionStereoError) -> str:
    """Return JUnit XML of a comparison that could not be made."""
    suite = _suite(1, errors=1)
    case = ET.SubElement(suite, "testcase", classname=_CLASS, name="compare")
    ET.SubElement(case, "error", type="error", message=_xml(str(error)))
    return _document(suite)


def json_of_error(error: MotionStereoError) -> str:
    """Return JSON of a comparison that could not be made."""
    return json.dumps({"error": str(error)}, indent=2) + "\n"


def _suite(tests: int, failures: int = 0, errors: int = 0) -> ET.Element:
    counts = {"tests": tests, "failures": failures, "errors": errors, "skipped": 0}
    said = {name: str(count) for name, count in counts.items()}
    return ET.Element("testsuite", {"name": "motionstereo compare", **said})


def _document(suite: ET.Element) -> str:
    text: bytes = ET.tostring(suite, encoding="utf-8", xml_declaration=True)
    return f"{text.decode()}\n"


def _xml(text: str) -> str:
    """Return a text without the characters that XML forbids."""
    return re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)
