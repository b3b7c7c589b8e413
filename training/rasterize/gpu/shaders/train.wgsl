// Training on splats in device memory: report steps, and read and change columns of the splats. The steps' gradients and
// Adam are in project.wgsl.

struct Parameters {
    count: u32,  // active invocations
    width: u32,  // columns to read or write, or maximum number of pairs
    stride: u32,  // from one row of values to the next, or number of losses
    slot: u32,  // first column, or place in the report
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> parts: array<f32>;
@group(0) @binding(2) var<storage, read_write> totals: array<f32>;
@group(0) @binding(3) var<storage, read_write> values: array<f32>;  // (N, stride)
@group(0) @binding(4) var<storage, read_write> report: array<u32>;  // NEEDED, COMPLETED, and losses of steps
@group(0) @binding(5) var<storage, read> starts: array<u32>;  // first pair of each splat, and number of pairs
@group(0) @binding(6) var<storage, read> losses: array<vec2f>;  // L1 and SSIM of parts of the image

var<workgroup> sums: array<vec2f, LANES>;

// Sum the parts of a step's losses, and check if its pairs fit into `width`. If not, this step and all later steps change
// no splats.
@compute @workgroup_size(LANES)
fn report_step(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    var sum = vec2f(0.0);
    for (var k = group_of(group) * LANES + lane; k < u.stride; k += LANES) { sum += losses[k]; }
    sums[lane] = sum;
    workgroupBarrier();
    if (lane > 0u) { return; }
    for (var k = 1u; k < LANES; k++) { sum += sums[k]; }
    report[u.slot] = bitcast<u32>(sum.x);
    report[u.slot + 1u] = bitcast<u32>(sum.y);
    if (report[NEEDED] != 0u) { return; }
    let total = starts[u.count];
    if (total > u.width) { report[NEEDED] = total; } else { report[COMPLETED] += 1u; }
}

// Copy parts to columns of values, from column slot on.
@compute @workgroup_size(LANES)
fn write_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k < u.count) { values[k / u.width * u.stride + u.slot + k % u.width] = parts[k]; }
}

// Raise the columns of each splat, from column slot on, to at least its minimum in parts.
@compute @workgroup_size(LANES)
fn raise_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count) { return; }
    let at = k / u.width * u.stride + u.slot + k % u.width;
    values[at] = max(values[at], parts[k / u.width]);
}

// Lower the columns of each splat, from column slot on, to at most its maximum in parts.
@compute @workgroup_size(LANES)
fn lower_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count) { return; }
    let at = k / u.width * u.stride + u.slot + k % u.width;
    values[at] = min(values[at], parts[k / u.width]);
}

// Copy columns of values, from column slot on, to totals.
@compute @workgroup_size(LANES)
fn read_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k < u.count) { totals[k] = values[k / u.width * u.stride + u.slot + k % u.width]; }
}
