// Render a Blender scene as photos with exact cameras, as training data for splats, on a Flamenco farm.
//
// Copy this file to the folder `scripts` next to the Flamenco Manager. Every worker's Blender needs the LODGS
// extension. The worker that creates the model also needs its trainer: set it in the preferences or in the
// environment variable LODGS_TRAINER_PYTHON. Workers must access the .blend file and the output folder.
// Every task can run again: existing images are kept, and the last task renders missing ones.

const JOB_TYPE = {
    label: "LODGS: capture a Blender scene",
    description: "Render views of a Blender scene with its own engine, as a COLMAP scene",
    settings: [
        { key: "blendfile", type: "string", required: true, visible: "web",
          description: "Blender file to capture" },
        { key: "output", type: "string", subtype: "dir_path", required: true,
          description: "Folder of the COLMAP scene, accessible to all workers under this path" },
        { key: "views_from", type: "string", default: "around", choices: ["around", "above", "cameras", "animation", "curve"],
          description: "Viewpoints: around or above the selection, all cameras, the animated camera, or along a curve" },
        { key: "curve", type: "string", default: "",
          description: "Name of the curve to follow" },
        { key: "views", type: "int32", default: 64, propargs: { min: 2, max: 2000 },
          description: "Number of views; for cameras, the number of cameras" },
        { key: "chunk", type: "int32", default: 8, propargs: { min: 1 },
          description: "Number of views per task" },
        { key: "width", type: "int32", default: 960, propargs: { min: 32, max: 8192 },
          description: "Image width in pixels" },
        { key: "height", type: "int32", default: 640, propargs: { min: 32, max: 8192 },
          description: "Image height in pixels" },
        { key: "blender", type: "string", default: "{blender}", visible: "hidden",
          description: "Path of the command blender, from the manager's variable" },
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
    const added = author.Task(name, "misc");
    added.addCommand(author.Command("exec", { exe, args }));
    for (const dependency of after) added.addDependency(dependency);
    job.addTask(added);
    return added;
}
