"""What a package index and GitHub show: the description of the package, and files that name the project's facts again."""

from __future__ import annotations

import importlib.util
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from tests.data import ROOT
from wrt.core import VERSION

README = (ROOT / "README.md").read_text(encoding="utf-8")
TARGET = re.compile(r"\]\(([^)]+)\)")


@pytest.fixture
def build(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return hatch_build.py; a plain class stands for the base class of the build system, which the tests do not need."""
    interface = ModuleType("hatchling.metadata.plugin.interface")
    interface.MetadataHookInterface = object  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, interface.__name__, interface)
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_description_on_a_package_index_has_absolute_links_to_files_of_the_tag(build: ModuleType) -> None:
    address = "https://example.org/a/wrt"
    text = build.description(README, address, "v9")
    assert len(TARGET.findall(text)) == len(TARGET.findall(README))
    own = [target for target in TARGET.findall(text) if target not in TARGET.findall(README)]
    assert len(own) > 10 and [target for target in TARGET.findall(text) if not target.startswith("https://")] == []
    for target in own:
        place = re.fullmatch(rf"{address}/(?:raw|blob)/v9/([^#]+)(?:#.*)?", target)
        assert place and (ROOT / place[1]).exists(), target
    assert len(re.findall(r"!\[[^]]*\]\(https://example.org/a/wrt/raw/", text)) == README.count("![") > 3


def test_a_description_without_an_address_has_no_broken_picture_or_link(build: ModuleType) -> None:
    text = build.description(README, "", "HEAD")
    assert "![" not in text and [target for target in TARGET.findall(text) if not target.startswith("https://")] == []
    assert [line for line in README.splitlines() if "](" not in line and "|:---:|" not in line and line not in text.splitlines()
            and not line.startswith("| a mesh in")] == []


def test_the_repository_is_the_one_in_which_a_workflow_runs(build: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GITHUB_REPOSITORY", raising=False)
    assert build.repository() == ""
    monkeypatch.setenv("GITHUB_SERVER_URL", "https://example.org")
    monkeypatch.setenv("GITHUB_REPOSITORY", "a/wrt")
    assert build.repository() == "https://example.org/a/wrt"


def test_the_citation_and_the_recipe_agree_with_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    recipe = (ROOT / "recipe" / "meta.yaml").read_text(encoding="utf-8")
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f'version = "{VERSION}"' in recipe
    names = {"pillow": "pillow", "openimageio": "py-openimageio"}
    wanted = [line.replace(name := re.split("[<>=]", line)[0], f"{names.get(name, name)} ") for line in project["dependencies"]]
    assert re.findall(r"^    - (\S+ [<>]\S+)$", recipe.split("run:")[1].split("test:")[0], re.MULTILINE) == [
        f"python {project['requires-python']}", *wanted]


@pytest.mark.parametrize("path", ["CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md", "paper/paper.md",
                                  ".github/pull_request_template.md"])
def test_links_lead_to_files(path: str) -> None:
    for target in TARGET.findall((ROOT / path).read_text(encoding="utf-8")):
        assert target.startswith("https://") or (ROOT / Path(path).parent / target.split("#")[0]).exists(), target


def test_the_paper_is_short_and_each_reference_is_listed_and_cited() -> None:
    text = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8")
    listed = re.findall(r"^@\w+\{(\w+),", (ROOT / "paper" / "references.bib").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(text.split()) <= 1000
    assert sorted(set(re.findall(r"@(\w+)", text))) == sorted(listed)
