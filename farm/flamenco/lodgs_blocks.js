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
        { key: "options", type: "string", default: "",
          description: "Further options of lodgs train, such as --set max_splats=500000" },
        { key: "lodgs", type: "string", default: "{lodgs}", visible: "hidden",
          description: "The command lodgs, by the manager's variable" },
    ],
};

function compileJob(job) {
    const { scene, output, columns, rows, method, preset, image_scale, options, lodgs } = job.settings;
    const plan = task(job, "plan", lodgs, [
        "blocks", "plan", "--scene", scene, "--out", output, "--cells", `${columns}x${rows}`,
        "--method", method, "--preset", preset, "--image-scale", `${image_scale}`,
        ...(options ? shellSplit(options) : []),
    ]);
    const blocks = [];
    for (let number = 1; number <= columns * rows; number++) {
        const file = path.join(output, "blocks", `${number}`, "job.toml");
        blocks.push(task(job, `block ${number}`, lodgs, ["train", file], [plan]));
    }
    task(job, "put together", lodgs, ["blocks", "run", output], blocks);
}

function task(job, name, exe, args, after = []) {
    const made = author.Task(name, "misc");
    made.addCommand(author.Command("exec", { exe, args }));
    for (const other of after) made.addDependency(other);
    job.addTask(made);
    return made;
}
