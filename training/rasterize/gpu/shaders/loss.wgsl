// L1 and structural similarity with their gradient. Images are (3, H, W). Each dispatch processes one channel, and each
// invocation one of its values.
//
// SSIM = n1 n2 / (d1 d2) with n1 = 2 mx my + C1, n2 = 2 (mxy - mx my) + C2, d1 = mx^2 + my^2 + C1 and
// d2 = (mxx - mx^2) + (myy - my^2) + C2 (Wang et al. 2004, Eq. 13), m the means in an 11x11 Gaussian window of
// sigma 1.5, with zeros outside the image. Only the sum of mxx and myy is needed. Windows are applied along x, then
// along y, in loops of fixed length. Compilers unroll these loops and turn the weights into constants.

struct Parameters { l1_weight: f32, ssim_weight: f32, width: u32, height: u32, channel: u32 }
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> image: array<f32>;
@group(0) @binding(2) var<storage, read> truth: array<f32>;
@group(0) @binding(3) var<storage, read_write> lines: array<vec4f>;  // windowed along x
@group(0) @binding(4) var<storage, read> across: array<vec4f>;  // same buffer, for reading
@group(0) @binding(5) var<storage, read_write> by_means: array<vec4f>;  // d SSIM by the windowed x, x^2 and xy
@group(0) @binding(6) var<storage, read> slopes: array<vec4f>;  // same buffer, for reading
@group(0) @binding(7) var<storage, read_write> similar: array<f32>;  // SSIM of each value
@group(0) @binding(8) var<storage, read_write> gradient: array<f32>;
@group(0) @binding(9) var<storage, read_write> different: array<f32>;  // |x - y| of each value
@group(0) @binding(10) var<storage, read> values: array<f32>;
@group(0) @binding(11) var<storage, read_write> totals: array<f32>;  // sum of 256 values each

const REACH: i32 = 5;
const C1: f32 = 0.0001;
const C2: f32 = 0.0009;
const SUM_LENGTH: u32 = 256;

fn window(k: i32) -> f32 {
    return WINDOW_MIDDLE * exp(f32(k * k) / -4.5);
}

struct Place { index: u32, x: i32, y: i32, inside: bool }

fn place_of(group: u32, lane: u32) -> Place {
    let index = group * LANES + lane;
    return Place(index, i32(index % u.width), i32(index / u.width), index < u.width * u.height);
}

// Return the index of a value in an image.
fn value_of(at: Place) -> u32 {
    return u.channel * u.width * u.height + at.index;
}

// Return the windowed mean of `across` along y.
fn mean_down(at: Place) -> vec4f {
    var sum = vec4f(0.0);
    for (var d = -REACH; d <= REACH; d++) {
        if (at.y + d < 0 || at.y + d >= i32(u.height)) { continue; }
        sum += window(d) * across[i32(at.index) + d * i32(u.width)];
    }
    return sum;
}

@compute @workgroup_size(LANES)
fn products(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    var sum = vec4f(0.0);
    for (var d = -REACH; d <= REACH; d++) {
        if (at.x + d < 0 || at.x + d >= i32(u.width)) { continue; }
        let x = image[i32(value_of(at)) + d];
        let y = truth[i32(value_of(at)) + d];
        sum += window(d) * vec4f(x, y, x * x + y * y, x * y);
    }
    lines[at.index] = sum;
}

@compute @workgroup_size(LANES)
fn similarity(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    let m = mean_down(at);
    let mx = m.x;
    let my = m.y;
    let n1 = 2.0 * mx * my + C1;
    let n2 = 2.0 * (m.w - mx * my) + C2;
    let d1 = mx * mx + my * my + C1;
    let d2 = m.z - mx * mx - my * my + C2;
    let value = n1 * n2 / (d1 * d2);
    let by_xx = -value / d2;
    let by_xy = 2.0 * n1 / (d1 * d2);
    let by_x = 2.0 * my * n2 / (d1 * d2) - 2.0 * mx * value / d1 - 2.0 * mx * by_xx - my * by_xy;
    similar[value_of(at)] = value;
    by_means[at.index] = vec4f(by_x, by_xx, by_xy, 0.0);
}

@compute @workgroup_size(LANES)
fn slopes_across(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    var sum = vec4f(0.0);
    for (var d = -REACH; d <= REACH; d++) {
        if (at.x + d < 0 || at.x + d >= i32(u.width)) { continue; }
        sum += window(d) * slopes[i32(at.index) + d];
    }
    lines[at.index] = sum;
}

// The window is symmetric, so the derivatives by the means propagate to a value as their windowed mean. The derivatives
// of x, x^2 and xy by x are 1, 2x and y.
@compute @workgroup_size(LANES)
fn finish(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = place_of(group_of(group), lane);
    if (!at.inside) { return; }
    let value = value_of(at);
    let x = image[value];
    let y = truth[value];
    let through_ssim = dot(mean_down(at).xyz, vec3f(1.0, 2.0 * x, y));
    gradient[value] = u.l1_weight * sign(x - y) - u.ssim_weight * through_ssim;
    different[value] = abs(x - y);
}

@compute @workgroup_size(LANES)
fn add(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group) * LANES + lane;
    let count = 3u * u.width * u.height;
    if (block * SUM_LENGTH >= count) { return; }
    var sum = 0.0;
    for (var k = block * SUM_LENGTH; k < min((block + 1u) * SUM_LENGTH, count); k++) { sum += values[k]; }
    totals[block] = sum;
}
