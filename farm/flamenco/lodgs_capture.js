// A Blender scene as photographs with exact cameras, to train splats from, rendered on a Flamenco farm.
//
// Put this file into the folder `scripts` beside the Flamenco Manager. Every worker's Blender has to have the
// extension LODGS, and the one that makes the model its trainer: by the preferences, or by the environment
// variable LODGS_TRAINER_PYTHON. Workers have to see the .blend and the output folder.
// Every task can run again: what is rendered is not rendered anew. The last one renders what is missing.

const JOB_TYPE = {
    label: "LODGS: capture a Blender scene",
    description: "Render views of a Blender scene with its own engine, and make a COLMAP scene of them",
    settings: [
        { key: "blendfile", type: "string", required: true, visible: "web",
          description: "The .blend to capture" },
        { key: "output", type: "string", subtype: "dir_path", required: true,
          description: "Folder that becomes the COLMAP scene, as all workers see it" },
        { key: "views_from", type: "string", default: "around", choices: ["around", "above", "cameras", "animation", "curve"],
          description: "From where: around or above what is selected, every camera, the animated camera, or along a curve" },
        { key: "curve", type: "string", default: "",
          description: "Name of the curve to walk along" },
        { key: "views", type: "int32", default: 64, propargs: { min: 2, max: 2000 },
          description: "How many views; of cameras, how many there are" },
        { key: "chunk", type: "int32", default: 8, propargs: { min: 1 },
          description: "How many views a task renders" },
        { key: "width", type: "int32", default: 960, propargs: { min: 32, max: 8192 },
          description: "Width of the pictures in pixels" },
        { key: "height", type: "int32", default: 640, propargs: { min: 32, max: 8192 },
          description: "Height of the pictures in pixels" },
        { key: "blender", type: "string", default: "{blender}", visible: "hidden",
          description: "The command blender, by the manager's variable" },
    ],
};

function compileJob(job) {
    const { blendfile, output, views_from, curve, views, chunk, width, height, blender } = job.settings;
    const from = views_from == "curve" ? ["--curve", curve] : [`--${views_from}`];
    const capture = [
        "--command", "lodgs", "capture", blendfile, "--out", output, ...from,
        "--views", `${views}`, "--size", `${width}x${height}`,
    ];
    const parts = [];
    for (let first = 1; first <= views; first += chunk) {
        const range = `${first}-${Math.min(first + chunk - 1, views)}`;
        parts.push(task(job, `views ${range}`, blender, [...capture, "--range", range]));
    }
    task(job, "model", blender, capture, parts);
}

function task(job, name, exe, args, after = []) {
    const made = author.Task(name, "misc");
    made.addCommand(author.Command("exec", { exe, args }));
    for (const other of after) made.addDependency(other);
    job.addTask(made);
    return made;
}
