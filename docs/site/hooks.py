"""What mkdocs.yml cannot say: the files of the site, the pages of the API reference, and differences between dialects of Markdown."""

from __future__ import annotations

import base64
import json
import posixpath
import re
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import wrt

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("*.md", "docs/*.md", "docs/lab_notes/*.md", "kernels/README.md", "docs/images/**/*.png",
           "docs/images/*.jpg", "docs/plots/*.svg", "docs/site/*.css")
API = {  # title: objects, of wrt unless the module is named
    "Structures and rays": "build Mesh load_mesh load_accel accel_from_tree ACCELERATORS DeviceGeometry camera_rays "
                           "wrt.accel.base.OneMesh wrt.accel.instances.Instances",
    "Hits": "wrt.accel.queries.answers.Hits wrt.accel.queries.answers.Counters all_hits count_hits first_hits visible",
    "Points": "contains winding_number closest_points signed_distance",
    "Your own kernels": "kernel ray_query",
    "Gradients": "torch jax",
    "Sensors": "sensors",
    "Pictures": "load_scene render Film Options Progress side_by_side wrt.picture.metrics",
    "Scenes": "Scene Settings Object Sphere Motion Camera OrthographicCamera FisheyeCamera PanoramaCamera wrt.scene.shapes",
    "Materials and lights": "Material Texture Checkerboard PointLight DirectionalLight SpotLight ConstantBackground GradientBackground "
                            "EnvironmentBackground",
    "Costs and steps": "profile inspect walk trace",
    "Other libraries' classes": "compat.trimesh compat.open3d compat.mujoco compat.newton",
    "Testing, errors": "testing InputError SceneWarning",
}
FENCED = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"(?<!!)\[([^]]*)\]\((?!\w+:|#)([^)#\s]+)[^)]*\)")
BLOCK = re.compile(r"^((?!- |\d+\. |  |\|).*\S\n)(?=(?:-|\d+\.) |\|)", re.MULTILINE)  # a line before a list or a table
NAME = re.compile(r"(?<!\[)`(wrt\.\w+)`(?!\])")


def api_pages() -> dict[str, str]:
    """Return the Markdown of each page of the API reference, by its title."""
    objects = {title: [name if name.startswith("wrt.") else f"wrt.{name}" for name in names.split()] for title, names in API.items()}
    documented = {name.split(".")[1] for names in objects.values() for name in names}
    if missing := set(dir(wrt)) - documented - {"__version__"}:
        raise PluginError(f"docs/site/hooks.py: API lacks the public names {sorted(missing)}")
    return {title: f"# {title}\n" + "".join(f"\n::: {name}\n" for name in names) for title, names in objects.items()}


def notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return the Markdown of a notebook with its outputs, and the pictures by their names."""
    text, pictures = "", {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        text += f"```python\n{source}\n```\n\n" if cell["cell_type"] == "code" else f"{source}\n\n"
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "text/html" in data:
                text += f'<div class="output">{"".join(data["text/html"])}</div>\n\n'
            elif "image/png" in data:
                name = f"{path.stem}-{len(pictures)}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                text += f"![Output of the code above]({name})\n\n"
            elif output.get("name") != "stderr":
                text += f"```text\n{''.join(output.get('text', data.get('text/plain', '')))}\n```\n\n"
    return text, pictures


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Take the files of the site from where they are in the project, so that their links lead to the same files as on a code host."""
    found = {path.relative_to(ROOT).as_posix(): path for pattern in SOURCES for path in sorted(ROOT.glob(pattern))}
    theme = [file for file in files if file.src_dir != config.docs_dir]
    site = Files([*theme, *(File.generated(config, name, abs_src_path=str(path)) for name, path in found.items())])
    for path in sorted(ROOT.glob("notebooks/*.ipynb")):
        text, pictures = notebook(path)
        for name, content in {f"{path.stem}.md": text, **pictures}.items():
            site.append(File.generated(config, f"notebooks/{name}", content=content))
    pages = [{title: f"api/{re.sub(r'[^a-z]+', '_', title.lower())}.md"} for title in API]
    for page, text in zip(pages, api_pages().values(), strict=True):
        site.append(File.generated(config, *page.values(), content=text))
    next(each for each in config.nav or () if "API" in each)["API"] = pages
    return site


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Write a page as Python-Markdown reads it; name files that the site lacks by their address, and link names to the API reference."""

    def outside(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page.file.src_uri), match[2]))
        if path.endswith(".ipynb"):
            return match[0].replace(".ipynb", ".md")
        if files.get_file_from_path(path) or not (ROOT / path).exists():
            return match[0]  # a page, or an error that --strict reports
        return f"[{match[1]}]({config.repo_url.rstrip('/')}/blob/HEAD/{path})" if config.repo_url else match[1]

    def public(match: re.Match[str]) -> str:
        return f"[{match[0]}][{match[1]}]" if match[1][4:] in wrt.__all__ else match[0]

    parts = FENCED.split(markdown)
    parts[::2] = [NAME.sub(public, LINK.sub(outside, BLOCK.sub(r"\1\n", part))) for part in parts[::2]]
    return "\n".join(parts)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert formulas to MathML, which browsers show without a script. Raise PluginError if a list or a table stayed plain text."""
    if plain := re.search(r"^(<p>)?(\|.*\||- \w.*)$", re.sub(r"<pre.*?</pre>", "", html, flags=re.DOTALL), re.MULTILINE):
        raise PluginError(f"{page.file.src_uri}: not read as a list or a table: {plain[0]}")
    html = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', lambda match: convert(unescape(match[1])), html, flags=re.DOTALL)
    return re.sub(r'<div class="arithmatex">\\\[(.*?)\\\]</div>',
                  lambda match: f'<div class="output">{convert(unescape(match[1]), display="block")}</div>', html, flags=re.DOTALL)
