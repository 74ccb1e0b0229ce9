"""Quality gates as JUnit XML, the format in which build servers (Jenkins, GitLab, GitHub actions) take test results.

One testsuite a job, one testcase a gate; a gate that is missed has a <failure> with its sentence. A job that ended with
nothing measured has its gates as <skipped/> and one more testcase, `bake`, with the <error>. There is no official
schema; elements and attributes are those that Jenkins' xunit plugin asks for. No times: same results, same bytes.
"""

import re
from collections.abc import Sequence
from typing import Final
from xml.etree import ElementTree

from kiln_schemas.errors import GateFailed, Problem
from kiln_schemas.gates import GateResult

BAKE: Final = "bake"
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 (section 2.2) has no way to write."""


def junit(job_name: str, results: Sequence[GateResult]) -> bytes:
    """The document of a job whose gates were measured."""
    suite = _suite(job_name, tests=len(results), failures=sum(not result.passed for result in results))
    for result in results:
        case = _case(suite, job_name, result.name)
        if not result.passed:
            _add(case, "failure", result.sentence(), GateFailed.code)
        ElementTree.SubElement(case, "system-out").text = result.sentence()
    return _document(suite)


def junit_of_error(job_name: str, gates: Sequence[str], problem: Problem) -> bytes:
    """The document of a job that ended with an error before these gates were measured."""
    suite = _suite(job_name, tests=len(gates) + 1, errors=1, skipped=len(gates))
    for name in gates:
        ElementTree.SubElement(_case(suite, job_name, name), "skipped")
    _add(_case(suite, job_name, BAKE), "error", problem.sentence(), problem.code)
    return _document(suite)


def _suite(job_name: str, *, tests: int, failures: int = 0, errors: int = 0, skipped: int = 0) -> ElementTree.Element:
    counts = {"tests": tests, "failures": failures, "errors": errors, "skipped": skipped}
    return ElementTree.Element(
        "testsuite", {"name": _clean(job_name)} | {name: str(count) for name, count in counts.items()}
    )


def _case(suite: ElementTree.Element, job_name: str, name: str) -> ElementTree.Element:
    return ElementTree.SubElement(suite, "testcase", classname=f"lightkiln.{_clean(job_name)}", name=name)


def _add(case: ElementTree.Element, kind: str, sentence: str, code: str) -> None:
    """What went wrong, as the attribute and as the text: build servers show the one or the other."""
    ElementTree.SubElement(case, kind, message=_clean(sentence), type=code).text = _clean(sentence)


def _clean(text: str) -> str:
    return _NOT_XML.sub("?", text)


def _document(suite: ElementTree.Element) -> bytes:
    ElementTree.indent(suite)
    text: bytes = ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True)
    return text + b"\n"
