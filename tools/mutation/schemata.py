"""Mutants of C code, all in one build: each sits behind a number, and the one whose number is chosen is alive.

Mutant schemata after Untch, Offutt and Harrold (1993): so a thousand mutants cost one compilation. What is constant at
compile time (tables, enums, macros, case labels) has no mutants.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import tree_sitter_c
from tree_sitter import Language, Node, Parser

_RELATIONS: Mapping[str, tuple[str, ...]] = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
}
_OPERATORS: Mapping[str, tuple[str, ...]] = {
    **_RELATIONS,
    "&&": ("||",),
    "||": ("&&",),
    "+": ("-",),
    "-": ("+",),
    "*": ("/",),
    "/": ("*",),
    "%": ("/",),
    "&": ("|",),
    "|": ("&",),
    "^": ("|",),
    "<<": (">>",),
    ">>": ("<<",),
}
_ASSIGNMENTS = {"+=": "-=", "-=": "+=", "*=": "/=", "/=": "*=", "|=": "&=", "&=": "|=", "<<=": ">>=", ">>=": "<<="}
_UPDATES = {"++": "--", "--": "++"}
_CONSTANT = {"enumerator", "array_declarator", "subscript_designator", "sizeof_expression", "preproc_def"}
"""What these hold must be known to the compiler."""
_NOTHING = {"0", "0U", "0.0f", "false", "NULL"}

#: In front of each source. A mutant that is reached marks itself, so that its tests are known.
PREFIX = """#include <stdint.h>
#include <string.h>
extern volatile uint32_t mutation_alive;
extern volatile uint8_t mutation_reached[];
#define MUTANT(n) (mutation_reached[n] = 1U, mutation_alive == (n))
"""


@dataclass(frozen=True)
class Mutant:
    """One small fault.

    Attributes
    ----------
    number : from 1.
    path : source file, relative to the project.
    line : in it, from 1.
    function : that it is in.
    before, after : text that is changed.
    nth : of those in the function with the same texts, from 1.
    """

    number: int
    path: str
    line: int
    function: str
    before: str
    after: str
    nth: int

    @property
    def key(self) -> str:
        """Name that does not change when lines move, and that no other mutant has."""
        nth = f" ({self.nth})" if self.nth > 1 else ""
        return f"{self.path}:{self.function}: {self.before} -> {self.after}{nth}"


@dataclass
class Schemata:
    """Source files with all their mutants in them.

    Attributes
    ----------
    mutants : in order of their numbers.
    """

    mutants: list[Mutant] = field(default_factory=list)
    _path: str = ""
    _function: str = ""
    _source: bytes = b""
    _alike: Counter[tuple[str, str, str, str]] = field(default_factory=Counter)

    def instrument(self, path: str, source: bytes) -> str:
        """Source text with its mutants."""
        self._path, self._source = path, source
        tree = Parser(Language(tree_sitter_c.language())).parse(source)
        if tree.root_node.has_error:
            raise ValueError(f"{path}: cannot be parsed")
        return PREFIX + f'#line 1 "{path}"\n' + self._rewrite(tree.root_node)

    def _text(self, node: Node) -> str:
        return self._source[node.start_byte : node.end_byte].decode()

    def _add(self, node: Node, before: str, after: str) -> int:
        shown_before, shown_after = (" ".join(text.split()) for text in (before, after))
        number = len(self.mutants) + 1
        line = node.start_point.row + 1
        alike = (self._path, self._function, shown_before, shown_after)
        self._alike[alike] += 1
        self.mutants.append(
            Mutant(number, self._path, line, self._function, shown_before, shown_after, self._alike[alike])
        )
        return number

    def _rewrite(self, node: Node) -> str:
        if node.type == "function_definition":
            return self._rewrite_function(node)
        if not self._function:
            return self._with_children(node)
        if node.type in _CONSTANT or (node.type == "declaration" and _is_static(node)):
            return self._text(node)
        changed = self._with_children(node)
        if node.type.endswith("_statement"):
            return self._statement(node, changed)
        for after, code in _expressions(node, self._text):
            number = self._add(node, self._text(node), after)
            changed = f"(MUTANT({number}) ? ({code}) : ({changed}))"
        return self._condition(node, changed) if _decides(node) else changed

    def _rewrite_function(self, node: Node) -> str:
        declarator, body = node.child_by_field_name("declarator"), node.child_by_field_name("body")
        while declarator is not None and declarator.type != "identifier":
            declarator = declarator.child_by_field_name("declarator")
        assert declarator is not None
        assert body is not None
        self._function = self._text(declarator)
        text = self._source[node.start_byte : body.start_byte].decode() + self._with_children(body)
        self._function = ""
        return text

    def _with_children(self, node: Node) -> str:
        label = node.child_by_field_name("value") if node.type == "case_statement" else None
        parts, end = [], node.start_byte
        for child in node.children:
            parts.append(self._source[end : child.start_byte].decode())
            parts.append(self._text(child) if child == label else self._rewrite(child))
            end = child.end_byte
        parts.append(self._source[end : node.end_byte].decode())
        return "".join(parts)

    def _condition(self, node: Node, changed: str) -> str:
        """What decides a branch, decided."""
        true, false = (self._add(node, f"? {self._text(node)}", after) for after in ("true", "false"))
        return f"(MUTANT({true}) ? 1 : MUTANT({false}) ? 0 : {changed} ? 1 : 0)"

    def _statement(self, node: Node, changed: str) -> str:
        """A statement that is left out, or returns nothing."""
        text = self._text(node)
        if node.type in ("break_statement", "continue_statement") or (
            node.type == "expression_statement" and not text.startswith("(void)")
        ):
            number = self._add(node, text, "")
            return f"{{ if (!MUTANT({number})) {{ {changed} }} }}"
        if node.type == "return_statement" and node.named_child_count:
            value = self._text(node.named_children[0])
            if value.isupper():  # an enumerator, which may be 0
                number = self._add(node, text, f"return {value} + 1")
                return f"{{ if (MUTANT({number})) {{ return {value} + 1; }} {changed} }}"
            if value not in _NOTHING and not value.endswith("{0}"):
                number = self._add(node, text, "return 0")
                nothing = f"__typeof__({value}) nothing; memset((void *)&nothing, 0, sizeof nothing); return nothing;"
                return f"{{ if (MUTANT({number})) {{ {nothing} }} {changed} }}"
        return changed


def _expressions(node: Node, text_of: Callable[[Node], str]) -> Iterator[tuple[str, str]]:
    """What may stand in place of an expression: for people, and for the compiler."""
    operator = node.child_by_field_name("operator")
    if node.type == "binary_expression":
        left, right = node.child_by_field_name("left"), node.child_by_field_name("right")
        assert operator is not None
        assert left is not None
        assert right is not None
        for other in _OPERATORS.get(text_of(operator), ()):
            one, two = text_of(left), text_of(right)
            yield f"{one} {other} {two}", f"({one}) {other} ({two})"
    elif node.type == "assignment_expression":
        left, right = node.child_by_field_name("left"), node.child_by_field_name("right")
        assert operator is not None
        if text_of(operator) in _ASSIGNMENTS and left is not None and right is not None:
            one, two, other = text_of(left), text_of(right), _ASSIGNMENTS[text_of(operator)]
            yield f"{one} {other} {two}", f"{one} {other} ({two})"
    elif node.type == "update_expression":
        assert operator is not None
        after = text_of(node).replace(text_of(operator), _UPDATES[text_of(operator)])
        yield after, after
    elif node.type == "unary_expression":
        argument = node.child_by_field_name("argument")
        if argument is not None and argument.type != "number_literal":
            yield text_of(argument), text_of(argument)
    elif node.type == "number_literal":
        text = text_of(node)
        real = "." in text and not text.lower().startswith("0x")
        after = f"{text} * 2.0f + 1.0f" if real else f"{text} + 1"
        yield after, after


def _decides(node: Node) -> bool:
    """Whether a branch is taken by an expression."""
    parent = node.parent
    if parent is None or parent.child_by_field_name("condition") != node:
        return False
    return parent.type in ("if_statement", "conditional_expression")


def _is_static(node: Node) -> bool:
    return any(child.type == "storage_class_specifier" for child in node.children)
