// What a training step does besides drawing, where splats stay on the device: photographs to numbers, statistics of
// density control, and Adam.

struct Parameters {
    count: u32,  // invocations that have something to do
    width: u32,  // numbers of a row that are trained
    stride: u32,  // from a row of values to the next
    by_stride: u32,  // from a row of gradients to the next
    trained: u32,  // of the width, the first ones, that have a gradient
    slot: u32,
    keep_m: f32,  // Adam's betas
    keep_v: f32,
    eps: f32,
    shrink: f32,  // how many times smaller the photograph is
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> photograph: array<u32>;  // (H, W) of four bytes
@group(0) @binding(2) var<storage, read> drawn: array<vec4f>;  // (H, W)
@group(0) @binding(3) var<storage, read_write> image: array<f32>;  // (3, H, W)
@group(0) @binding(4) var<storage, read_write> truth: array<f32>;  // (3, H, W)
@group(0) @binding(5) var<storage, read> gradient: array<f32>;  // (3, H, W)
@group(0) @binding(6) var<storage, read_write> by_picture: array<vec4f>;  // (H, W)
@group(0) @binding(7) var<storage, read> parts: array<f32>;
@group(0) @binding(8) var<storage, read_write> totals: array<f32>;
@group(0) @binding(9) var<storage, read> radii: array<f32>;  // (N,)
@group(0) @binding(10) var<storage, read> by_rows: array<f32>;  // (N, by_stride)
@group(0) @binding(11) var<storage, read_write> stats: array<f32>;  // (N, STATS)
@group(0) @binding(12) var<storage, read_write> values: array<f32>;  // (N, stride)
@group(0) @binding(13) var<storage, read_write> moments: array<vec2f>;  // (N, width): first and second
@group(0) @binding(14) var<storage, read> rates: array<vec2f>;  // (width): rates, and scales of second moments

// Columns of stats, as Model has them by name.
const GRADIENT_SUM: u32 = 0;
const SEEN: u32 = 1;
const GRADIENT_MAX: u32 = 2;
const RADIUS_MAX: u32 = 3;
const OPACITY_SUM: u32 = 4;
const STATS: u32 = 5;
// Columns of splats and of their gradients (project.wgsl).
const LOGIT: u32 = 3;
const LOG_SCALES: u32 = 8;
const BY_MEAN2D: u32 = 12;
// Moments below these are cut off, as on the processor.
const M_TINY: f32 = 1e-30;
const V_TINY: f32 = 1e-36;

var<workgroup> shares: array<f32, LANES>;

// A picture and its photograph as the loss takes them.
@compute @workgroup_size(LANES)
fn unpack(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = group_of(group) * LANES + lane;
    if (at >= u.count) { return; }
    let seen = drawn[at];
    let photographed = unpack4x8unorm(photograph[at]);
    for (var k = 0u; k < 3u; k++) {
        image[k * u.count + at] = seen[k];
        truth[k * u.count + at] = photographed[k];
    }
}

// The loss's gradient as blending takes it.
@compute @workgroup_size(LANES)
fn pack(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = group_of(group) * LANES + lane;
    if (at >= u.count) { return; }
    by_picture[at] = vec4f(gradient[at], gradient[u.count + at], gradient[2u * u.count + at], 0.0);
}

// The sum of all parts, by one workgroup.
@compute @workgroup_size(LANES)
fn total(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    var sum = 0.0;
    for (var k = group_of(group) * LANES + lane; k < u.count; k += LANES) { sum += parts[k]; }
    shares[lane] = sum;
    workgroupBarrier();
    if (lane == 0u) {
        sum = 0.0;
        for (var k = 0u; k < LANES; k++) { sum += shares[k]; }
        totals[u.slot] = sum;
    }
}

// Some columns of values, from the slot on, become what is in parts.
@compute @workgroup_size(LANES)
fn put(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k < u.count) { values[k / u.width * u.stride + u.slot + k % u.width] = parts[k]; }
}

// Log-scales rise to the least one of each splat, in parts.
@compute @workgroup_size(LANES)
fn widen(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count) { return; }
    for (var k = 0u; k < 3u; k++) {
        let at = i * u.stride + LOG_SCALES + k;
        values[at] = max(values[at], parts[i]);
    }
}

// Some columns of values, from the slot on.
@compute @workgroup_size(LANES)
fn look(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k < u.count) { totals[k] = values[k / u.width * u.stride + u.slot + k % u.width]; }
}

// What density control decides by.
@compute @workgroup_size(LANES)
fn count(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count || radii[i] == 0.0) { return; }
    let by = i * u.by_stride + BY_MEAN2D;
    let steep = length(vec2f(by_rows[by], by_rows[by + 1u])) / u.shrink;
    let at = i * STATS;
    stats[at + GRADIENT_SUM] += steep;
    stats[at + SEEN] += 1.0;
    stats[at + GRADIENT_MAX] = max(stats[at + GRADIENT_MAX], steep);
    stats[at + RADIUS_MAX] = max(stats[at + RADIUS_MAX], radii[i]);
    stats[at + OPACITY_SUM] += 1.0 / (1.0 + exp(-values[i * u.stride + LOGIT]));
}

// A step of Adam (Kingma and Ba 2015, Algorithm 1), a number each. What was not drawn has a gradient of zero.
@compute @workgroup_size(LANES)
fn adam(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count) { return; }
    let i = k / u.width;
    let j = k % u.width;
    var g = 0.0;
    if (j < u.trained && radii[i] > 0.0) { g = by_rows[i * u.by_stride + j]; }
    var m = u.keep_m * moments[k].x + (1.0 - u.keep_m) * g;
    var v = u.keep_v * moments[k].y + (1.0 - u.keep_v) * (g * g);
    m = select(0.0, m, abs(m) > M_TINY);
    v = select(0.0, v, v > V_TINY);
    moments[k] = vec2f(m, v);
    values[i * u.stride + j] -= rates[j].x * m / (sqrt(v * rates[j].y) + u.eps);
}
