// L1 and structural similarity with their gradient. Images are (H, W, 3); an invocation takes one of their values.
//
// SSIM = n1 n2 / (d1 d2) with n1 = 2 mx my + C1, n2 = 2 (mxy - mx my) + C2, d1 = mx^2 + my^2 + C1 and
// d2 = (mxx - mx^2) + (myy - my^2) + C2 (Wang et al. 2004, Eq. 13), m the means in an 11x11 Gaussian window of
// sigma 1.5, with zeros outside the image.

struct Parameters { l1_weight: f32, ssim_weight: f32, width: u32, height: u32 }
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> image: array<f32>;
@group(0) @binding(2) var<storage, read> truth: array<f32>;
@group(0) @binding(3) var<storage, read_write> lines: array<f32>;  // (3, H, W, 3), windowed along x
@group(0) @binding(4) var<storage, read> across: array<f32>;  // the same, to read
@group(0) @binding(5) var<storage, read_write> of_truth: array<f32>;  // (2, H, W, 3), its windowed y and y^2
@group(0) @binding(6) var<storage, read> truths: array<f32>;  // the same, to read
@group(0) @binding(7) var<storage, read_write> by_means: array<f32>;  // (3, H, W, 3), d SSIM by windowed x, x^2, xy
@group(0) @binding(8) var<storage, read> slopes: array<f32>;  // the same, to read
@group(0) @binding(9) var<storage, read_write> similar: array<f32>;  // SSIM of each value
@group(0) @binding(10) var<storage, read_write> gradient: array<f32>;
@group(0) @binding(11) var<storage, read_write> different: array<f32>;  // |x - y| of each value
@group(0) @binding(12) var<storage, read> values: array<f32>;
@group(0) @binding(13) var<storage, read_write> totals: array<f32>;  // of each 256 values

const REACH: i32 = 5;
const C1: f32 = 0.0001;
const C2: f32 = 0.0009;
const EACH: u32 = 256;

fn window(k: i32) -> f32 {
    return WINDOW_MIDDLE * exp(f32(k * k) / -4.5);
}

struct Place { index: u32, x: i32, y: i32, inside: bool }

fn place_of(group: u32, lane: u32) -> Place {
    let index = group * LANES + lane;
    let pixel = index / 3u;
    return Place(index, i32(pixel % u.width), i32(pixel / u.width), pixel < u.width * u.height);
}

fn plane() -> u32 {
    return 3u * u.width * u.height;
}

// The windowed mean along y of a plane of `across`.
fn mean_down(k: u32, at: Place) -> f32 {
    var sum = 0.0;
    for (var d = max(-REACH, -at.y); d <= min(REACH, i32(u.height) - 1 - at.y); d++) {
        sum += window(d) * across[k * plane() + u32(i32(at.index) + d * 3 * i32(u.width))];
    }
    return sum;
}

@compute @workgroup_size(LANES)
fn products(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    var sums = vec3f(0.0);
    for (var d = max(-REACH, -at.x); d <= min(REACH, i32(u.width) - 1 - at.x); d++) {
        let other = u32(i32(at.index) + d * 3);
        let x = image[other];
        sums += window(d) * vec3f(x, x * x, x * truth[other]);
    }
    for (var k = 0u; k < 3u; k++) { lines[k * plane() + at.index] = sums[k]; }
}

@compute @workgroup_size(LANES)
fn moments(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    for (var k = 0u; k < 2u; k++) { of_truth[k * plane() + at.index] = mean_down(k, at); }
}

@compute @workgroup_size(LANES)
fn similarity(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    let mx = mean_down(0u, at);
    let my = truths[at.index];
    let n1 = 2.0 * mx * my + C1;
    let n2 = 2.0 * (mean_down(2u, at) - mx * my) + C2;
    let d1 = mx * mx + my * my + C1;
    let d2 = mean_down(1u, at) - mx * mx + truths[plane() + at.index] - my * my + C2;
    let value = n1 * n2 / (d1 * d2);
    let by_xx = -value / d2;
    let by_xy = 2.0 * n1 / (d1 * d2);
    similar[at.index] = value;
    by_means[at.index] =
        2.0 * my * n2 / (d1 * d2) - 2.0 * mx * value / d1 - 2.0 * mx * by_xx - my * by_xy;
    by_means[plane() + at.index] = by_xx;
    by_means[2u * plane() + at.index] = by_xy;
}

@compute @workgroup_size(LANES)
fn slopes_across(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    for (var k = 0u; k < 3u; k++) {
        var sum = 0.0;
        for (var d = max(-REACH, -at.x); d <= min(REACH, i32(u.width) - 1 - at.x); d++) {
            sum += window(d) * slopes[k * plane() + u32(i32(at.index) + d * 3)];
        }
        lines[k * plane() + at.index] = sum;
    }
}

// The window is symmetric, so what the means' derivatives give back to a value is their own windowed mean; x reaches
// the means of x, x^2 and xy with 1, 2x and y.
@compute @workgroup_size(LANES)
fn finish(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    let x = image[at.index];
    let y = truth[at.index];
    let through_ssim = mean_down(0u, at) + 2.0 * x * mean_down(1u, at) + y * mean_down(2u, at);
    gradient[at.index] = u.l1_weight * sign(x - y) - u.ssim_weight * through_ssim;
    different[at.index] = abs(x - y);
}

@compute @workgroup_size(LANES)
fn add(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group) * LANES + lane;
    if (block * EACH >= plane()) { return; }
    var sum = 0.0;
    for (var k = block * EACH; k < min((block + 1u) * EACH, plane()); k++) { sum += values[k]; }
    totals[block] = sum;
}
