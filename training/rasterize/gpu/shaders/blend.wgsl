// Blend the splats of every tile front to back, and compute the gradients in the backward pass.
//
// A workgroup renders a tile. Each of its 64 invocations has one column and four rows of pixels, stored in vec4s; eight
// neighbouring invocations form a strip of 8x4 pixels. Splats are fetched 64 at a time, and each strip blends only
// those that touch it. The colour of a pixel is the sum of w c with w = alpha T, where T is the transmittance of the
// splats in front (3DGS, Eq. 3). T becomes negative when a pixel is finished, and is negative from the start outside
// the image. All later splats then fail the test against TRANSMITTANCE_MIN, and |T| is preserved.

struct Parameters { background: vec4f, width: u32, height: u32, across: u32, limited: u32, absolute: u32 }
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> rows: array<Row>;
@group(0) @binding(2) var<storage, read> colors: array<vec4f>;
@group(0) @binding(3) var<storage, read> entries: array<vec2u>;  // splat and index of each pair, tile by tile
@group(0) @binding(4) var<storage, read> ranges: array<vec2u>;  // range of pairs of each tile
@group(0) @binding(5) var<storage, read> limit: array<f32>;  // (H, W)
@group(0) @binding(6) var<storage, read_write> drawn: array<vec4f>;  // (H, W): colour and T
@group(0) @binding(7) var<storage, read_write> visited: array<vec2u>;  // ranges up to the last pair that any pixel uses
@group(0) @binding(8) var<storage, read_write> median: array<i32>;  // (H, W): splat that reduces T to a half
@group(0) @binding(9) var<storage, read> all_ranges: array<vec2u>;  // of each tile, also of pairs that no pixel uses
@group(0) @binding(10) var<storage, read> image: array<vec4f>;  // (H, W): the forward pass's drawn
@group(0) @binding(11) var<storage, read> by_image: array<vec4f>;  // (H, W): gradient by colour and by alpha
@group(0) @binding(12) var<storage, read_write> pair_sums: array<f32>;  // (P, PAIR_SUMS)
@group(0) @binding(13) var<storage, read_write> pair_weights: array<f32>;  // (P, 3): largest, sum, pixels

const STRIPS: u32 = 8;
const STRIP_LANES: u32 = 8;
const FOUR_ROWS = vec4f(0.0, 1.0, 2.0, 3.0);
const BATCH: u32 = 4;  // splats whose shares are summed over the tile together
const STRIDE: u32 = LANES + 1u;  // from one sum's shares to the next, to avoid bank conflicts

var<workgroup> batch_rows: array<Row, LANES>;
var<workgroup> batch_colors: array<vec3f, LANES>;
var<workgroup> strips_of: array<u32, LANES>;  // bit mask of the strips that each splat touches
var<workgroup> touching: array<atomic<u32>, 2 * STRIPS>;  // bit mask of the splats that touch each strip
var<workgroup> furthest: atomic<u32>;
var<workgroup> shares: array<f32, BATCH * PAIR_SUMS * STRIDE>;

struct Pixels {
    first: vec2u,  // topmost of the four
    center: vec2f,
    inside: vec4<bool>,
}

fn pixels_of(tile: u32, lane: u32) -> Pixels {
    let first = corner_of(tile, lane / STRIP_LANES) + vec2u(lane % STRIP_LANES, 0u);
    let lines = vec4u(first.y, first.y + 1u, first.y + 2u, first.y + 3u);
    let inside = (lines < vec4u(u.height)) & vec4<bool>(first.x < u.width);
    return Pixels(first, vec2f(first) + 0.5, inside);
}

// Return the first pixel of a tile's strip.
fn corner_of(tile: u32, strip: u32) -> vec2u {
    return vec2u(tile % u.across, tile / u.across) * TILE + vec2u(strip % 2u * STRIP_LANES, strip / 2u * 4u);
}

fn index_of(pixels: Pixels, k: u32) -> u32 {
    return (pixels.first.y + k) * u.width + pixels.first.x;
}

// Fetch the next splats of the tile and find the strips that they touch; call in uniform control flow.
fn fetch(tile: u32, first: u32, count: u32, lane: u32) {
    workgroupBarrier();
    if (lane < 2u * STRIPS) { atomicStore(&touching[lane], 0u); }
    workgroupBarrier();
    if (lane < count) {
        let splat = entries[first + lane].x;
        let row = rows[splat];
        var bits = 0u;
        for (var strip = 0u; strip < STRIPS; strip++) {
            if (touches(row, vec2f(corner_of(tile, strip)) + 0.5, vec2f(7.0, 3.0))) {
                bits |= 1u << strip;
                atomicOr(&touching[2u * strip + lane / 32u], 1u << (lane % 32u));
            }
        }
        strips_of[lane] = bits;
        batch_rows[lane] = row;
        batch_colors[lane] = colors[splat].xyz;
    }
    workgroupBarrier();
}

struct Alpha {
    dx: f32,
    dy: vec4f,
    e_x: vec4f,  // e = conic d
    e_y: vec4f,
    uncapped: vec4f,
    alpha: vec4f,
}

fn alpha_of(row: Row, center: vec2f) -> Alpha {
    let dx = center.x - row.mean.x;
    let dy = center.y - row.mean.y + FOUR_ROWS;
    let e_x = row.conic.x * dx + row.conic.y * dy;
    let e_y = row.conic.y * dx + row.conic.z * dy;
    let log2_alpha = row.log2_opacity - 0.5 * LOG2_E * (dx * e_x + dy * e_y);
    let uncapped = exp2(log2_alpha);
    let alpha = select(vec4f(0.0), min(uncapped, vec4f(ALPHA_MAX)), log2_alpha >= vec4f(LOG2_ALPHA_MIN));
    return Alpha(dx, dy, e_x, e_y, uncapped, alpha);
}

@compute @workgroup_size(LANES)
fn forward(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = group_of(group);
    let pixels = pixels_of(tile, lane);
    let range = ranges[tile];
    var t = select(vec4f(-1.0), vec4f(1.0), pixels.inside);
    var limits = vec4f(0.0);
    if (u.limited != 0u) {
        for (var k = 0u; k < 4u; k++) {
            if (pixels.inside[k]) { limits[k] = limit[index_of(pixels, k)]; }
        }
    }
    var red = vec4f(0.0);
    var green = vec4f(0.0);
    var blue = vec4f(0.0);
    var middle = vec4i(-1);
    var reached = range.x;
    if (lane == 0u) { atomicStore(&furthest, 0u); }  // not every driver clears workgroup memory
    for (var first = range.x; first < range.y; first += LANES) {
        let count = min(LANES, range.y - first);
        fetch(tile, first, count, lane);
        for (var half = 0u; half < 2u; half++) {
            var remaining = atomicLoad(&touching[lane / STRIP_LANES * 2u + half]);
            while (remaining != 0u && any(t > vec4f(0.0))) {
                let k = half * 32u + countTrailingZeros(remaining);
                remaining &= remaining - 1u;
                reached = first + k + 1u;
                let a = alpha_of(batch_rows[k], pixels.center).alpha;
                let t_next = t - a * t;
                var takes = t_next > vec4f(TRANSMITTANCE_MIN);
                if (u.limited != 0u) { takes = takes & (vec4f(batch_rows[k].depth) <= limits); }
                let w = select(vec4f(0.0), a * t, takes);
                red += w * batch_colors[k].x;
                green += w * batch_colors[k].y;
                blue += w * batch_colors[k].z;
                let halves = takes & (t > vec4f(0.5)) & (t_next <= vec4f(0.5));
                if (any(halves)) { middle = select(middle, vec4i(i32(entries[first + k].x)), halves); }
                t = select(-abs(t), t_next, takes);
            }
        }
    }
    workgroupBarrier();
    atomicMax(&furthest, reached);
    workgroupBarrier();
    if (lane == 0u) { visited[tile] = vec2u(range.x, atomicLoad(&furthest)); }
    for (var k = 0u; k < 4u; k++) {
        if (pixels.inside[k]) {
            let t_end = abs(t[k]);
            drawn[index_of(pixels, k)] = vec4f(vec3f(red[k], green[k], blue[k]) + t_end * u.background.xyz, t_end);
            median[index_of(pixels, k)] = middle[k];
        }
    }
}

fn share(splat: u32, column: u32, lane: u32, lanes: vec4f) {
    shares[(splat * PAIR_SUMS + column) * STRIDE + lane] = lanes.x + lanes.y + lanes.z + lanes.w;
}

// Sum the shares of the strips in a bit mask.
fn sum_strips(column: u32, strips: u32) -> f32 {
    var sum = 0.0;
    var remaining = strips;
    while (remaining != 0u) {
        let first = column * STRIDE + countTrailingZeros(remaining) * STRIP_LANES;
        remaining &= remaining - 1u;
        for (var k = 0u; k < STRIP_LANES; k++) { sum += shares[first + k]; }
    }
    return sum;
}

// Compute each pair's share of its splat's gradients.
//
// With h = d loss / d colour, a pixel contributes the sum of w (c.h) + T_end (background.h - d loss / d alpha) to the
// loss. Let Q_i be the part of this sum behind splat i. Then
//     d loss / d alpha_i = T_i (c_i.h) - Q_i / (1 - alpha_i)
// and, as sigma = -ln alpha + const,
//     g = d loss / d sigma = alpha_i Q_i / (1 - alpha_i) - w_i (c_i.h).
// Q starts as the complete sum, colour.h - T_end d loss / d alpha, and is reduced front to back together with T.
@compute @workgroup_size(LANES)
fn backward(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = group_of(group);
    let pixels = pixels_of(tile, lane);
    let range = ranges[tile];
    var t = select(vec4f(-1.0), vec4f(1.0), pixels.inside);
    var q = vec4f(0.0);
    var by_red = vec4f(0.0);
    var by_green = vec4f(0.0);
    var by_blue = vec4f(0.0);
    for (var k = 0u; k < 4u; k++) {
        if (pixels.inside[k]) {
            let pixel = image[index_of(pixels, k)];
            let h = by_image[index_of(pixels, k)];
            q[k] = dot(pixel.xyz, h.xyz) - pixel.w * h.w;
            by_red[k] = h.x;
            by_green[k] = h.y;
            by_blue[k] = h.z;
        }
    }
    for (var first = range.x; first < range.y; first += LANES) {
        let count = min(LANES, range.y - first);
        fetch(tile, first, count, lane);
        for (var start = 0u; start < count; start += BATCH) {
            let batch_size = min(BATCH, count - start);
            let touching_bits = atomicLoad(&touching[lane / STRIP_LANES * 2u + start / 32u]);
            var remaining = (touching_bits >> (start % 32u)) % (1u << BATCH);
            while (remaining != 0u) {
                let k = countTrailingZeros(remaining);
                remaining &= remaining - 1u;
                let color = batch_colors[start + k];
                let a = alpha_of(batch_rows[start + k], pixels.center);
                let t_next = t - a.alpha * t;
                let takes = t_next > vec4f(TRANSMITTANCE_MIN);
                let w = select(vec4f(0.0), a.alpha * t, takes);
                t = select(-abs(t), t_next, takes);
                let received = w * (color.x * by_red + color.y * by_green + color.z * by_blue);
                q -= received;
                let moves = takes & (a.uncapped < vec4f(ALPHA_MAX));
                let g = select(vec4f(0.0), a.alpha * q / (1.0 - a.alpha) - received, moves);
                let g_x = g * a.e_x;
                let g_y = g * a.e_y;
                share(k, G, lane, g);
                share(k, G_X, lane, g_x);
                share(k, G_Y, lane, g_y);
                share(k, G_XX, lane, g_x * a.e_x);
                share(k, G_XY, lane, g_x * a.e_y);
                share(k, G_YY, lane, g_y * a.e_y);
                if (u.absolute != 0u) {
                    share(k, ABS_X, lane, abs(g_x));
                    share(k, ABS_Y, lane, abs(g_y));
                }
                share(k, RED, lane, w * by_red);
                share(k, RED + 1u, lane, w * by_green);
                share(k, RED + 2u, lane, w * by_blue);
            }
            workgroupBarrier();
            if (lane < batch_size * PAIR_SUMS) {
                let k = start + lane / PAIR_SUMS;
                let column = lane % PAIR_SUMS;
                var sum = 0.0;
                if (u.absolute != 0u || (column != ABS_X && column != ABS_Y)) { sum = sum_strips(lane, strips_of[k]); }
                pair_sums[entries[first + k].y * PAIR_SUMS + column] = sum;
            }
            workgroupBarrier();
        }
    }
    let unused = (all_ranges[tile].y - range.y) * PAIR_SUMS;
    for (var k = lane; k < unused; k += LANES) {
        pair_sums[entries[range.y + k / PAIR_SUMS].y * PAIR_SUMS + k % PAIR_SUMS] = 0.0;
    }
}

// Compute the largest weight, the sum of weights and the number of pixels of each pair.
@compute @workgroup_size(LANES)
fn weigh(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = group_of(group);
    let pixels = pixels_of(tile, lane);
    let range = ranges[tile];
    var t = select(vec4f(-1.0), vec4f(1.0), pixels.inside);
    for (var first = range.x; first < range.y; first += BATCH) {
        let batch_size = min(BATCH, range.y - first);
        for (var k = 0u; k < batch_size; k++) {
            let a = alpha_of(rows[entries[first + k].x], pixels.center).alpha;
            let t_next = t - a * t;
            let takes = t_next > vec4f(TRANSMITTANCE_MIN);
            let w = select(vec4f(0.0), a * t, takes);
            t = select(-abs(t), t_next, takes);
            let largest = max(max(w.x, w.y), max(w.z, w.w));
            share(k, 0u, lane, vec4f(largest, 0.0, 0.0, 0.0));
            share(k, 1u, lane, w);
            share(k, 2u, lane, select(vec4f(0.0), vec4f(1.0), w > vec4f(0.0)));
        }
        workgroupBarrier();
        let k = lane / 3u;
        let column = lane % 3u;
        if (k < batch_size) {
            var result = 0.0;
            for (var i = 0u; i < LANES; i++) {
                let value = shares[(k * PAIR_SUMS + column) * STRIDE + i];
                result = select(result + value, max(result, value), column == 0u);
            }
            pair_weights[entries[first + k].y * 3u + column] = result;
        }
        workgroupBarrier();
    }
}
