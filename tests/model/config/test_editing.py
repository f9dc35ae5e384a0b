import pytest
from ruamel.yaml.comments import CommentedMap

from model.config.document import ConfigError, parse_document
from model.config.editing import data_text, edited_text

TEXT = """\
# A rig.
plate:
    length: 0.300 # measured

    layers:
      - {thickness: 1.50 mm}
eras: {SW: {at: [0, 0], damping: 1.5}} # one
"""


def test_edited_text_keeps_what_was_not_changed() -> None:
    """Comments, indentation, order and numbers stay as they were written."""

    def change(data: CommentedMap) -> None:
        data["plate"].insert(0, "width", 0.2)
        data["eras"]["SW"].pop("damping")
        data["eras"]["SW"]["damping"] = 2.5

    edited = edited_text(parse_document("rig.yaml", TEXT), change)
    expected = TEXT.replace("    length", "    width: 0.2\n    length")
    assert edited == expected.replace("damping: 1.5", "damping: 2.5")


def test_edited_text_has_one_kind_of_line_end_when_the_file_has_crlf() -> None:
    """A file with CR LF, comments included, is written with LF throughout."""
    document = parse_document("f.yaml", "# first\r\na: 1  # one\r\n# last\r\nb: 2\r\n")
    text = edited_text(document, lambda data: data.update(a=3))
    assert "\r" not in text
    assert parse_document("f.yaml", text).data == {"a": 3, "b": 2}


def test_edited_text_refuses_comments_that_it_cannot_keep() -> None:
    """A file that would come out changed is left alone."""
    document = parse_document("rig.yaml", "a: # between\n\n  value\n\n")
    assert document.data == {"a": "value"}
    with pytest.raises(ConfigError, match=r"rig\.yaml"):
        edited_text(document, lambda data: None)


def test_data_text_is_read_back_as_it_was() -> None:
    """Words of YAML 1.1 and numbers among text come back too."""
    data = {"z": ["NO", "0x10", "1", 1, 1.5, None, True], "a": {"b": "12 in", "c": "1:30"}}
    assert parse_document("new", data_text(data)).data == data
    assert list(parse_document("new", data_text(data)).data) == ["z", "a"]
