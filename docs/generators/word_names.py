"""Names of the words of a message, for pages and files that list every word."""

from collections.abc import Iterator, Mapping

from drivers.protocol.records import Bits, Number, Numbers, Record, Rows


def word_names(record: Record, counts: Mapping[str, int]) -> list[str]:
    """Return the names of the words of a record; counts: number of rows by count field."""
    return [*_names(record, counts)]


def _names(record: Record, counts: Mapping[str, int]) -> Iterator[str]:
    for field in record.fields:
        match field:
            case Number(name=name, words=2):
                yield f"{name} high"
                yield f"{name} low"
            case Number(name=name):
                yield name
            case Bits(parts=parts):
                yield " and ".join(f"{name} ({bits} bits)" for name, bits in parts)
            case Numbers(name=name, count=count):
                yield from (f"{name} {number}" for number in range(counts[count]))
            case Rows(name=name, count=str(count), record=each):
                for number in range(counts[count]):
                    yield from (f"{name} {number} {inner}" for inner in _names(each, counts))
            case _:
                raise TypeError(type(field))
