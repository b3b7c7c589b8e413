// Train Gaussian splats of a large scene in cells on a Flamenco farm.
//
// Copy this file to the folder `scripts` next to the Flamenco Manager, and define a manager variable {lodgs}:
// the path of the command `lodgs` on each platform. Workers must access the scene and the output folder.
// Every task can run again: it resumes, and finished parts are not trained again.

const JOB_TYPE = {
    label: "LODGS: splats in cells",
    description: "Divide a COLMAP scene into cells on the ground, train each cell and merge the results",
    settings: [
        { key: "scene", type: "string", subtype: "dir_path", required: true,
          description: "Folder of the COLMAP scene" },
        { key: "output", type: "string", subtype: "dir_path", required: true,
          description: "Run folder, accessible to all workers under this path" },
        { key: "columns", type: "int32", default: 2, propargs: { min: 1, max: 64 },
          description: "Number of columns along the longer side of the ground" },
        { key: "rows", type: "int32", default: 2, propargs: { min: 1, max: 64 },
          description: "Number of cells per column" },
        { key: "method", type: "string", default: "flod", choices: ["flod", "octree", "clod", "lodge", "tree", "matryoshka", "3dgs"],
          description: "Training method" },
        { key: "preset", type: "string", default: "draft", choices: ["draft", "standard", "paper"],
          description: "Preset: draft trains for minutes, paper for hours" },
        { key: "image_scale", type: "float", default: 0, propargs: { min: 0, max: 1 },
          description: "Size of training images relative to the photos; 0 uses that of the preset" },
        { key: "polish", type: "int32", default: 300, propargs: { min: 0 },
          description: "Steps that fit each cell's borders to its neighbours; 0 disables" },
        { key: "options", type: "string", default: "",
          description: "Additional options of lodgs train, such as --set max_splats=500000" },
        { key: "lodgs", type: "string", default: "{lodgs}", visible: "hidden",
          description: "Path of the command lodgs, from the manager's variable" },
    ],
};

function compileJob(job) {
    const { scene, output, columns, rows, method, preset, image_scale, polish, options, lodgs } = job.settings;
    const plan = task(job, "plan", lodgs, [
        "blocks", "plan", scene, "--out", output, "--cells", `${columns}x${rows}`,
        "--method", method, "--preset", preset, "--polish", `${polish}`,
        ...(image_scale ? ["--image-scale", `${image_scale}`] : []),
        ...(options ? shellSplit(options) : []),
    ]);
    const numbers = Array.from({ length: columns * rows }, (_, index) => index + 1);
    const part = (kind, after) => task(job, kind, lodgs, ["blocks", "run", output, "--only", kind], after);
    const coarse = part("coarse", [plan]);
    const blocks = numbers.map((number) => part(`block-${number}`, [coarse]));
    const seams = polish ? numbers.map((number) => part(`seam-${number}`, blocks)) : blocks;
    task(job, "merge", lodgs, ["blocks", "run", output], seams);
}

function task(job, name, exe, args, after = []) {
    const added = author.Task(name, "misc");
    added.addCommand(author.Command("exec", { exe, args }));
    for (const dependency of after) added.addDependency(dependency);
    job.addTask(added);
    return added;
}
