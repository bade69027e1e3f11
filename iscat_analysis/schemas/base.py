"""Types and base classes of the models of documents."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model

from iscat_analysis.records import Column

Number = float | None
Count = Annotated[int, Field(ge=0)]
Natural = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)] | None
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)] | None
Interval = tuple[Number, Number]
Row4 = tuple[Number, Number, Number, Number]
Matrix4 = tuple[Row4, Row4, Row4, Row4]
Mode = Literal["mass", "localize", "joint", "size", "track"]
Scheme = Literal["iscat", "cobri", "darkfield"]
Emission = Literal["dong2021", "reciprocal"]
Convention = Literal["exact", "dong2021"]
Parameter = Literal["x_nm", "y_nm", "z_nm", "mass_kda"]
End = Literal["movie", "border", "inside"]

_VALUES: dict[str, Any] = {
    "count": Count,
    "natural": Natural,
    "number": Number,
    "positive": Positive,
    "share": Share,
    "text": str | None,
    "end": End,
    **dict.fromkeys(("not_negative", "span"), NotNegative | None),
}
"""Type of the values of a column; that of its status depends on the table."""


Notes = Annotated[list[str], Field(description="What the user should know, one line each")]
ABSENT: Any = None
"""Default of a key that may be absent, whatever its type."""


class Part(BaseModel):
    """A part of a document; what a key holds is said below it."""

    model_config = ConfigDict(defer_build=True, use_attribute_docstrings=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Put descriptions on one line."""
        for field in cls.model_fields.values():
            field.description = " ".join((field.description or "").split()) or None


class Document(Part):
    """A document, or a part of one, that may have further keys."""

    model_config = ConfigDict(extra="allow")


class Closed(Part):
    """A part that has the keys named here and no other."""

    model_config = ConfigDict(extra="forbid")


def row_model(name: str, doc: str, columns: Iterable[Column], status: Any) -> type[Closed]:
    """Make the model of one row of a table from the registry of its columns."""
    fields: dict[str, Any] = {}
    for column in columns:
        values = (_VALUES | {"status": status})[column.values]
        about = Field(default=None if column.optional else ..., description=column.description)
        fields[column.name] = (values | None if column.optional else values), about
    return create_model(name, __base__=Closed, __doc__=doc, **fields)
