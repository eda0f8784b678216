"""One row for each scene: the figures of eval, and what the exported file lost. Run by the Snakefile."""

import csv
import json


def at(tree, *keys):
    """A number deep in a tree of JSON, or None; PSNR may be the word inf."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return None if tree is None else float(tree)


def row(name, metrics, exported):
    mean = metrics.get("mean")
    ply = next((file for file in exported["files"] if file["name"] == "scene.ply"), {})
    return {
        "scene": name,
        "test views": at(mean, "views"),
        "PSNR": at(mean, "full", "psnr"),
        "masked PSNR": at(mean, "mask", "psnr"),
        "SSIM": at(mean, "full", "ssim"),
        "masked SSIM": at(mean, "mask", "ssim"),
        "FLIP": at(mean, "full", "flip"),
        "LPIPS (VGG)": at(mean, "lpips", "vgg", "full"),
        "masked LPIPS (VGG)": at(mean, "lpips", "vgg", "mask"),
        "FID": at(mean, "fid", "full"),
        "residue": at(mean, "residue"),
        "Gaussians": at(exported, "gaussians"),
        "export to anchors, dB": at(ply, "anchors", "full", "psnr"),
        "scene.ply, MB": ply["bytes"] / 1e6 if "bytes" in ply else None,
    }


DIGITS = {"test views": 0, "PSNR": 2, "masked PSNR": 2, "Gaussians": 0, "export to anchors, dB": 2, "FID": 1, "scene.ply, MB": 1}


def text(key, value):
    if value is None:
        return ""
    return value if isinstance(value, str) else f"{value:.{DIGITS.get(key, 3)}f}"


def read(path):
    with open(path, encoding="utf-8") as file:
        return json.load(file)


def main(names, metrics, exports, csv_path, markdown_path):
    rows = [row(name, read(m), read(e)) for name, m, e in zip(names, metrics, exports)]
    # What no scene has is left out.
    keys = [key for key in rows[0] if any(row[key] is not None for row in rows)]
    lines = [[text(key, row[key]) for key in keys] for row in rows]
    with open(csv_path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(keys)
        writer.writerows(lines)
    # Every figure's mean over the scenes that have it.
    mean = []
    for key in keys[1:]:
        values = [row[key] for row in rows if row[key] is not None]
        mean.append(text(key, sum(values) / len(values)))
    with open(markdown_path, "w", encoding="utf-8") as file:
        for line in [keys, ["---"] + ["---:"] * (len(keys) - 1), *lines, ["mean", *mean]]:
            file.write("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n")


main(
    snakemake.params.names,  # noqa: F821
    snakemake.input.metrics,  # noqa: F821
    snakemake.input.exports,  # noqa: F821
    snakemake.output.csv,  # noqa: F821
    snakemake.output.markdown,  # noqa: F821
)
