// Splats of a scene that is too large for one computer, trained in cells on a Flamenco farm.
//
// Put this file into the folder `scripts` beside the Flamenco Manager, and give the manager a variable {lodgs}:
// on each platform the path of the command `lodgs`. Workers have to see the scene and the output folder.
// Every task can run again: it goes on where it was, and what is finished is not made anew.

const JOB_TYPE = {
    label: "LODGS: splats in cells",
    description: "Divide a COLMAP scene into cells on the ground, train each, and put them together",
    settings: [
        { key: "scene", type: "string", subtype: "dir_path", required: true,
          description: "Folder of the COLMAP scene" },
        { key: "output", type: "string", subtype: "dir_path", required: true,
          description: "Folder of the run, as all workers see it" },
        { key: "columns", type: "int32", default: 2, propargs: { min: 1, max: 64 },
          description: "How many columns of cells, across the longer side of the ground" },
        { key: "rows", type: "int32", default: 2, propargs: { min: 1, max: 64 },
          description: "How many cells in each column" },
        { key: "method", type: "string", default: "flod", choices: ["flod", "octree", "clod", "lodge", "tree", "3dgs"],
          description: "What to train" },
        { key: "preset", type: "string", default: "draft", choices: ["draft", "standard", "paper"],
          description: "How long to train" },
        { key: "image_scale", type: "float", default: 0.5, propargs: { min: 0.01, max: 1 },
          description: "Size of training images over photographs" },
        { key: "polish", type: "int32", default: 300, propargs: { min: 0 },
          description: "Steps that fit each cell's borders to the cells beside it; 0 for none" },
        { key: "options", type: "string", default: "",
          description: "Further options of lodgs train, such as --set max_splats=500000" },
        { key: "lodgs", type: "string", default: "{lodgs}", visible: "hidden",
          description: "The command lodgs, by the manager's variable" },
    ],
};

function compileJob(job) {
    const { scene, output, columns, rows, method, preset, image_scale, polish, options, lodgs } = job.settings;
    const plan = task(job, "plan", lodgs, [
        "blocks", "plan", scene, "--out", output, "--cells", `${columns}x${rows}`,
        "--method", method, "--preset", preset, "--image-scale", `${image_scale}`, "--polish", `${polish}`,
        ...(options ? shellSplit(options) : []),
    ]);
    const numbers = Array.from({ length: columns * rows }, (_, index) => index + 1);
    const part = (kind, after) => task(job, kind, lodgs, ["blocks", "run", output, "--only", kind], after);
    const coarse = part("coarse", [plan]);
    const blocks = numbers.map((number) => part(`block-${number}`, [coarse]));
    const seams = polish ? numbers.map((number) => part(`seam-${number}`, blocks)) : blocks;
    task(job, "put together", lodgs, ["blocks", "run", output], seams);
}

function task(job, name, exe, args, after = []) {
    const made = author.Task(name, "misc");
    made.addCommand(author.Command("exec", { exe, args }));
    for (const other of after) made.addDependency(other);
    job.addTask(made);
    return made;
}
