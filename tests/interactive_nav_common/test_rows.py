"""Tables for people; files of rows are tested with what writes them."""

from interactive_nav_common.rows import markdown


def test_markdown_tables_by_hand():
    assert markdown(("a", "b"), [(1, "x")]) == "| a | b |\n| --- | --- |\n| 1 | x |\n"
