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
    "count": Count, "natural": Natural, "number": Number, "positive": Positive,
    "not_negative": NotNegative | None, "share": Share, "span": NotNegative | None,
    "text": str | None, "end": End,
}  # fmt: skip
"""Type of the values of a column; that of its status depends on the table."""


def key(description: str) -> Any:
    """Describe a key that is always there."""
    return Field(description=description)


def maybe(description: str) -> Any:
    """Describe a key that may be absent."""
    return Field(default=None, description=description)


Error = Annotated[Number, key("Its standard error")]
KnownError = Annotated[NotNegative, key("Its standard error")]
Ends = Annotated[Interval, key("Its 95 % confidence interval")]
Low = Annotated[Number, key("End of its 95 % interval")]
High = Annotated[Number, key("The other end")]
Notes = Annotated[list[str], key("What the user should know, one line each")]
Written = Annotated[str, maybe("When printed: the folder that was written")]


class Document(BaseModel):
    """A document, or a part of one, that may have further keys."""

    model_config = ConfigDict(extra="allow", defer_build=True)  # a command needs one of them


class Closed(BaseModel):
    """A part that has the keys named here and no other."""

    model_config = ConfigDict(extra="forbid", defer_build=True)


def row_model(name: str, doc: str, columns: Iterable[Column], status: Any) -> type[Closed]:
    """Make the model of one row of a table from the registry of its columns."""
    fields: dict[str, Any] = {}
    for column in columns:
        values = (_VALUES | {"status": status})[column.values]
        if column.optional:
            fields[column.name] = values | None, maybe(column.description)
        else:
            fields[column.name] = values, key(column.description)
    return create_model(name, __base__=Closed, __doc__=doc, **fields)
