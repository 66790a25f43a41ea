"""Annotations of jaxtyping as one reads them: `Float[Tensor, "*batch 3"]`, always in these quotation marks."""

from typing import Any

from griffe import Attribute, Expr, ExprSubscript, ExprTuple, Extension, Function

_AROUND = "'\" "  # a space too: it stands in front of one word alone so that linters take it for no name


class Shapes(Extension):
    """Mends shapes, which griffe takes for forward references where they could be code, as "3" is."""

    def on_attribute_instance(self, *, attr: Attribute, **kwargs: Any) -> None:
        """Of an attribute, or a property."""
        _quote(attr.annotation)

    def on_function_instance(self, *, func: Function, **kwargs: Any) -> None:
        """Of parameters, and of what is returned."""
        _quote(func.returns)
        for parameter in func.parameters:
            _quote(parameter.annotation)


def _quote(annotation: Expr | str | None) -> None:
    parts = annotation.iterate(flat=False) if isinstance(annotation, Expr) else ()
    for part in (annotation, *parts):
        if isinstance(part, ExprSubscript) and part.canonical_path.startswith("jaxtyping."):
            assert isinstance(part.slice, ExprTuple)
            *array, shape = part.slice.elements
            part.slice.elements = [*array, f'"{str(shape).strip(_AROUND)}"']
        elif part is not annotation and isinstance(part, Expr):
            _quote(part)
