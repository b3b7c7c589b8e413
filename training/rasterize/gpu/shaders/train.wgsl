// Training steps on splats in device memory: convert photos, collect the statistics of density control, and run Adam.

struct Parameters {
    count: u32,  // active invocations
    width: u32,  // trained numbers per row
    stride: u32,  // from one row of values to the next
    by_stride: u32,  // from one row of gradients to the next
    trained: u32,  // first numbers of a row, which have a gradient
    slot: u32,  // first column, first rate, or index of the total
    keep_m: f32,  // Adam's betas
    keep_v: f32,
    eps: f32,
    shrink: f32,  // factor by which the photo was downscaled
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> photo: array<u32>;  // (H, W), four bytes per pixel
@group(0) @binding(2) var<storage, read> drawn: array<vec4f>;  // (H, W)
@group(0) @binding(3) var<storage, read_write> image: array<f32>;  // (3, H, W)
@group(0) @binding(4) var<storage, read_write> truth: array<f32>;  // (3, H, W)
@group(0) @binding(5) var<storage, read> gradient: array<f32>;  // (3, H, W)
@group(0) @binding(6) var<storage, read_write> by_image: array<vec4f>;  // (H, W)
@group(0) @binding(7) var<storage, read> parts: array<f32>;
@group(0) @binding(8) var<storage, read_write> totals: array<f32>;
@group(0) @binding(9) var<storage, read> radii: array<f32>;  // (N,)
@group(0) @binding(10) var<storage, read> by_rows: array<f32>;  // (N, by_stride)
@group(0) @binding(11) var<storage, read_write> stats: array<f32>;  // (N, STATS)
@group(0) @binding(12) var<storage, read_write> values: array<f32>;  // (N, stride)
@group(0) @binding(13) var<storage, read_write> moments: array<vec2f>;  // (N, width): first and second
@group(0) @binding(14) var<storage, read> rates: array<vec2f>;  // learning rates and scales of second moments

// Columns of stats, in the order of STATS in device_model.py.
const GRADIENT_SUM: u32 = 0;
const SEEN: u32 = 1;
const GRADIENT_MAX: u32 = 2;
const RADIUS_MAX: u32 = 3;
const OPACITY_SUM: u32 = 4;
const STATS: u32 = 5;
// Columns of splats and their gradients (project.wgsl).
const LOGIT: u32 = 3;
const LOG_SCALES: u32 = 8;
const BY_MEAN2D: u32 = 12;
// Smaller moments are set to zero, as on the CPU.
const M_TINY: f32 = 1e-30;
const V_TINY: f32 = 1e-36;

@group(0) @binding(16) var<storage, read_write> report: array<u32>;  // NEEDED, COMPLETED, and losses of steps
@group(0) @binding(17) var<storage, read> starts: array<u32>;  // first pair of each splat, and number of pairs

const NEEDED: u32 = 0;  // number of pairs of the first step that had too many; zero without one
const COMPLETED: u32 = 1;  // number of steps before it
const LOSSES: u32 = 2;

var<workgroup> lane_sums: array<f32, LANES>;

// Convert an image and its photo to the inputs of the loss.
@compute @workgroup_size(LANES)
fn unpack(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = group_of(group) * LANES + lane;
    if (at >= u.count) { return; }
    let pixel = drawn[at];
    let photo_colour = unpack4x8unorm(photo[at]);
    for (var k = 0u; k < 3u; k++) {
        image[k * u.count + at] = pixel[k];
        truth[k * u.count + at] = photo_colour[k];
    }
}

// Convert the loss's gradient to the input of blending.
@compute @workgroup_size(LANES)
fn pack(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = group_of(group) * LANES + lane;
    if (at >= u.count) { return; }
    by_image[at] = vec4f(gradient[at], gradient[u.count + at], gradient[2u * u.count + at], 0.0);
}

// Sum all parts in one workgroup.
@compute @workgroup_size(LANES)
fn total(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    var sum = 0.0;
    for (var k = group_of(group) * LANES + lane; k < u.count; k += LANES) { sum += parts[k]; }
    lane_sums[lane] = sum;
    workgroupBarrier();
    if (lane == 0u) {
        sum = 0.0;
        for (var k = 0u; k < LANES; k++) { sum += lane_sums[k]; }
        report[LOSSES + u.slot] = bitcast<u32>(sum);
    }
}

// Check if the pairs of a step fit into `width`. If not, this step and all later steps change no splats.
@compute @workgroup_size(LANES)
fn check(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    if (group_of(group) * LANES + lane > 0u || report[NEEDED] != 0u) { return; }
    let total = starts[u.count];
    if (total > u.width) { report[NEEDED] = total; } else { report[COMPLETED] += 1u; }
}

// Copy parts to columns of values, from column slot on.
@compute @workgroup_size(LANES)
fn write_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k < u.count) { values[k / u.width * u.stride + u.slot + k % u.width] = parts[k]; }
}

// Raise the log-scales of each splat to at least its minimum in parts.
@compute @workgroup_size(LANES)
fn raise_log_scales(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count) { return; }
    for (var k = 0u; k < 3u; k++) {
        let at = i * u.stride + LOG_SCALES + k;
        values[at] = max(values[at], parts[i]);
    }
}

// Copy columns of values, from column slot on, to totals.
@compute @workgroup_size(LANES)
fn read_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k < u.count) { totals[k] = values[k / u.width * u.stride + u.slot + k % u.width]; }
}

// Collect the statistics of density control.
@compute @workgroup_size(LANES)
fn collect_stats(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count || radii[i] == 0.0 || report[NEEDED] != 0u) { return; }
    let by = i * u.by_stride + BY_MEAN2D;
    let norm = length(vec2f(by_rows[by], by_rows[by + 1u])) / u.shrink;
    let at = i * STATS;
    stats[at + GRADIENT_SUM] += norm;
    stats[at + SEEN] += 1.0;
    stats[at + GRADIENT_MAX] = max(stats[at + GRADIENT_MAX], norm);
    stats[at + RADIUS_MAX] = max(stats[at + RADIUS_MAX], radii[i]);
    stats[at + OPACITY_SUM] += 1.0 / (1.0 + exp(-values[i * u.stride + LOGIT]));
}

// Make an Adam step (Kingma and Ba 2015, Algorithm 1), one number per invocation. Splats that were not drawn have zero
// gradients.
@compute @workgroup_size(LANES)
fn adam(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count || report[NEEDED] != 0u) { return; }
    let i = k / u.width;
    let j = k % u.width;
    var g = 0.0;
    if (j < u.trained && radii[i] > 0.0) { g = by_rows[i * u.by_stride + j]; }
    var m = u.keep_m * moments[k].x + (1.0 - u.keep_m) * g;
    var v = u.keep_v * moments[k].y + (1.0 - u.keep_v) * (g * g);
    m = select(0.0, m, abs(m) > M_TINY);
    v = select(0.0, v, v > V_TINY);
    moments[k] = vec2f(m, v);
    values[i * u.stride + j] -= rates[u.slot + j].x * m / (sqrt(v * rates[u.slot + j].y) + u.eps);
}
