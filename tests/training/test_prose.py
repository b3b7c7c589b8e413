"""The prose check finds what it counts and nothing else."""

from tools.prose import problems


def module(body: str) -> dict[str, str]:
    return {"module.py": body}


def test_plain_code_has_no_problems():
    assert (
        problems(module('"""Load scenes."""\n\ndef load(path):\n    """Return the scene in a folder."""\n'))
        == []
    )


def test_openings_and_the_word_what_are_counted():
    report = problems(module('def f():\n    """Where what is needed is found."""\n'), listed=1)
    assert [line.split(":")[0].strip() for line in report] == ["docstrings", "docstrings", "module.py"]


def test_errors_and_descriptions_are_read():
    source = 'f(description="How it is")\nraise LodgsError(f"What {x} is not there.", "Go.")\n'
    assert {line.split(":")[0] for line in problems(module(source))} == {"interface", "errors"}
    for source in ('setting(1, "How it is.")', 'Control("a", 1, 0, 2, "A", "How it is")'):
        assert [line.split(":")[0] for line in problems(module(f"{source}\n"))] == ["interface"]


def test_function_words_as_names_are_counted():
    assert "found 1" in problems(module("found = 1\n"))[0]


def test_class_name_with_two_meanings_is_reported():
    sources = {"a.py": "class View: ...\n", "b.py": "class View: ...\n"}
    assert problems(sources) == ["class View is defined 2 times"]
    assert problems({"a.py": "class Method: ...\n", "b.py": "class Method: ...\n"}) == []
