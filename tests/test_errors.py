import ast
from pathlib import Path

import pytest
from facts import assert_facts

import recon_cli
from recon_cli import errors
from recon_cli.errors import FormatError, InputError, ReconError, list_names

PACKAGE = Path(recon_cli.__file__).parent


def test_a_short_list_is_given_in_full_and_a_long_one_with_the_number_of_the_others():
    assert list_names(["a", "b"]) == "a, b"
    assert_facts(list_names(["a", "b", "c"], most=2), "a, b", 1)


def _find_error_classes() -> dict[str, bool]:
    """Returns whether each error class of the package has a hint of its own."""
    usual = {name: bool(item.usual_hint) for name, item in vars(errors).items()
             if isinstance(item, type) and issubclass(item, ReconError)}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            bases = [base.id for base in getattr(node, "bases", ()) if isinstance(base, ast.Name)]
            if isinstance(node, ast.ClassDef) and usual.keys() & set(bases):
                usual.setdefault(node.name, False)
    return usual


@pytest.mark.integration
def test_every_error_says_what_to_type_next() -> None:
    usual, without = _find_error_classes(), []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                continue
            hinted = any(keyword.arg in ("hint", None) for keyword in node.keywords)
            if usual.get(node.func.id) is False and not hinted:
                without.append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    assert not without


def test_a_class_of_errors_has_a_usual_hint_that_one_of_its_own_replaces() -> None:
    assert FormatError("broken").hint == FormatError.usual_hint
    assert FormatError("broken", hint="Do this.").hint == "Do this."
    assert not InputError("broken", hint="").hint
