// Rows brought together: those that are wanted of a buffer, and what a splat's pairs hold, added up in the order in
// which the splat met its tiles: the same bits every time, however many bands the tiles are in.

struct Parameters {
    count: u32,
    columns: u32,  // of sums that are meant: features have no part in the absolute gradients; or of rows
    first: u32,  // row of all that the source begins with
    end: u32,
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> spans: array<vec2u>;
@group(0) @binding(2) var<storage, read> pair_sums: array<f32>;  // (P, PAIR_SUMS)
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;  // (M, SUMS), added to
@group(0) @binding(4) var<storage, read_write> by_colours: array<f32>;  // (M, 3), added to
@group(0) @binding(5) var<storage, read> pair_weights: array<f32>;  // (P, 3)
@group(0) @binding(6) var<storage, read_write> weights: array<f32>;  // (M, 3): largest, sum, pixels so far
@group(0) @binding(7) var<storage, read> index: array<u32>;  // rows that are wanted
@group(0) @binding(8) var<storage, read> source: array<u32>;  // rows of whatever numbers
@group(0) @binding(9) var<storage, read_write> taken: array<u32>;

@compute @workgroup_size(LANES)
fn take(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count) { return; }
    let row = index[k / u.columns];
    if (row >= u.first && row < u.end) { taken[k] = source[(row - u.first) * u.columns + k % u.columns]; }
}

@compute @workgroup_size(LANES)
fn gradients(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count) { return; }
    var found: array<f32, PAIR_SUMS>;
    for (var k = 0u; k < u.columns; k++) { found[k] = sums[i * SUMS + k]; }
    for (var k = 0u; k < 3u; k++) { found[RED + k] = by_colours[i * 3u + k]; }
    let end = spans[i].x + spans[i].y;
    for (var pair = spans[i].x; pair < end; pair++) {
        for (var k = 0u; k < PAIR_SUMS; k++) { found[k] += pair_sums[pair * PAIR_SUMS + k]; }
    }
    for (var k = 0u; k < u.columns; k++) { sums[i * SUMS + k] = found[k]; }
    for (var k = 0u; k < 3u; k++) { by_colours[i * 3u + k] = found[RED + k]; }
}

@compute @workgroup_size(LANES)
fn contributions(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count) { return; }
    var found = vec3f(weights[i * 3u], weights[i * 3u + 1u], weights[i * 3u + 2u]);
    let end = spans[i].x + spans[i].y;
    for (var pair = spans[i].x; pair < end; pair++) {
        let at = pair * 3u;
        found = vec3f(
            max(found.x, pair_weights[at]), found.y + pair_weights[at + 1u], found.z + pair_weights[at + 2u],
        );
    }
    for (var k = 0u; k < 3u; k++) { weights[i * 3u + k] = found[k]; }
}
