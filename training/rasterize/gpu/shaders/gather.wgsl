// Gather rows: select rows of a buffer by index, and sum the rows of a splat's pairs in the order of its tiles. The
// result has the same bits for any number of bands.

struct Parameters {
    count: u32,
    columns: u32,  // of rows to select; for gradients, 1 adds to sums and 0 replaces them
    first: u32,  // index of the source's first row
    end: u32,
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> spans: array<vec2u>;
@group(0) @binding(2) var<storage, read> pair_sums: array<f32>;  // (P, PAIR_SUMS)
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;  // (M, PAIR_SUMS)
@group(0) @binding(4) var<storage, read_write> by_features: array<f32>;  // (M, 3), added to
@group(0) @binding(5) var<storage, read> pair_weights: array<f32>;  // (P, 3)
@group(0) @binding(6) var<storage, read_write> weights: array<f32>;  // (M, 3), accumulated: largest, sum, pixels
@group(0) @binding(7) var<storage, read> index: array<u32>;  // rows to select
@group(0) @binding(8) var<storage, read> source: array<u32>;  // rows of any 4-byte numbers
@group(0) @binding(9) var<storage, read_write> selected: array<u32>;

@compute @workgroup_size(LANES)
fn select_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count) { return; }
    let row = index[k / u.columns];
    if (row >= u.first && row < u.end) { selected[k] = source[(row - u.first) * u.columns + k % u.columns]; }
}

// Return the sum of a number and of a column of a splat's pairs.
fn sum_of(i: u32, column: u32, start: f32) -> f32 {
    var total = start;
    let end = spans[i].x + spans[i].y;
    for (var pair = spans[i].x; pair < end; pair++) { total += pair_sums[pair * PAIR_SUMS + column]; }
    return total;
}

// Each workgroup sums the columns of 64 splats.
@compute @workgroup_size(LANES)
fn gradients(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let first = group_of(group) * LANES;
    let end = min(first + LANES, u.count) * PAIR_SUMS;
    for (var k = first * PAIR_SUMS + lane; k < end; k += LANES) {
        var start = 0.0;
        if (u.columns != 0u) { start = sums[k]; }
        sums[k] = sum_of(k / PAIR_SUMS, k % PAIR_SUMS, start);
    }
}

// Features affect no absolute gradients, and have gradients of their own instead of the colour's.
@compute @workgroup_size(LANES)
fn feature_gradients(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let first = group_of(group) * LANES;
    let end = min(first + LANES, u.count) * PAIR_SUMS;
    for (var k = first * PAIR_SUMS + lane; k < end; k += LANES) {
        let i = k / PAIR_SUMS;
        let column = k % PAIR_SUMS;
        if (column < ABS_X) { sums[k] = sum_of(i, column, sums[k]); }
        if (column >= RED) {
            let at = i * 3u + column - RED;
            by_features[at] = sum_of(i, column, by_features[at]);
        }
    }
}

@compute @workgroup_size(LANES)
fn contributions(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count) { return; }
    var total = vec3f(weights[i * 3u], weights[i * 3u + 1u], weights[i * 3u + 2u]);
    let end = spans[i].x + spans[i].y;
    for (var pair = spans[i].x; pair < end; pair++) {
        let at = pair * 3u;
        total = vec3f(
            max(total.x, pair_weights[at]), total.y + pair_weights[at + 1u], total.z + pair_weights[at + 2u],
        );
    }
    for (var k = 0u; k < 3u; k++) { weights[i * 3u + k] = total[k]; }
}
