// L1 and structural similarity of an image and a photo, with their gradient. Each workgroup processes a tile of 16x16
// pixels, and reads five more pixels on each side.
//
// SSIM = n1 n2 / (d1 d2) with n1 = 2 mx my + C1, n2 = 2 (mxy - mx my) + C2, d1 = mx^2 + my^2 + C1 and
// d2 = (mxx - mx^2) + (myy - my^2) + C2 (Wang et al. 2004, Eq. 13), m the means in an 11x11 Gaussian window of
// sigma 1.5, with zeros outside the image. Only the sum of mxx and myy is needed. Windows are applied along x, then
// along y, in loops of fixed length. Compilers unroll these loops and turn the weights into constants.

struct Parameters {
    l1_weight: f32,
    ssim_weight: f32,
    width: u32,
    height: u32,
    floats: u32,  // 1 if a pixel of the photo has three floats instead of four bytes
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> drawn: array<vec4f>;  // (H, W)
@group(0) @binding(2) var<storage, read> photo: array<u32>;  // (H, W)
@group(0) @binding(3) var<storage, read_write> slopes: array<f32>;  // (9, H, W): d SSIM by the windowed x, x^2 and xy
@group(0) @binding(4) var<storage, read_write> parts: array<vec2f>;  // L1 and SSIM of each workgroup
@group(0) @binding(5) var<storage, read> slopes_of: array<f32>;  // same buffer as slopes, for reading
@group(0) @binding(6) var<storage, read_write> by_image: array<vec4f>;  // (H, W)

const REACH: u32 = 5;
const TAPS: u32 = 11;
const SIDE: u32 = TILE + 2u * REACH;
const AREA: u32 = SIDE * SIDE;
const LINES: u32 = SIDE * TILE;
const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

var<workgroup> pixels: array<vec2f, AREA>;  // of one channel: image and photo, or the first two slopes
var<workgroup> third_slopes: array<f32, AREA>;
var<workgroup> lines: array<vec4f, LINES>;  // windowed along x
var<workgroup> sums: array<vec2f, LANES>;

fn window(k: u32) -> f32 {
    let distance = f32(k) - f32(REACH);
    return WINDOW_MIDDLE * exp(distance * distance / -4.5);
}

// Return the first pixel of a tile.
fn corner_of(tile: u32) -> vec2u {
    let across = (u.width + TILE - 1u) / TILE;
    return vec2u(tile % across, tile / across) * TILE;
}

// Return the index of pixel k of a tile with its border; u.width * u.height outside the image.
fn index_of(corner: vec2u, k: u32) -> u32 {
    let at = corner + vec2u(k % SIDE, k / SIDE) - REACH;  // wraps to a large number at the left and at the top
    return select(u.width * u.height, at.y * u.width + at.x, at.x < u.width && at.y < u.height);
}

fn photo_value(at: u32, channel: u32) -> f32 {
    if (u.floats != 0u) { return bitcast<f32>(photo[3u * at + channel]); }
    return unpack4x8unorm(photo[at])[channel];
}

// Return the windowed mean of `lines` along y, for line k of the tile.
fn mean_down(column: u32, k: u32) -> vec4f {
    var sum = vec4f(0.0);
    for (var d = 0u; d < TAPS; d++) { sum += window(d) * lines[(k + d) * TILE + column]; }
    return sum;
}

// Compute the derivatives of SSIM, and the sums of L1 and SSIM.
@compute @workgroup_size(LANES)
fn compare(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let corner = corner_of(group_of(group));
    let count = u.width * u.height;
    let column = lane % TILE;
    var sum = vec2f(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        for (var k = lane; k < AREA; k += LANES) {
            let at = index_of(corner, k);
            var pixel = vec2f(0.0);
            if (at < count) { pixel = vec2f(drawn[at][channel], photo_value(at, channel)); }
            pixels[k] = pixel;
        }
        workgroupBarrier();
        for (var k = lane; k < LINES; k += LANES) {
            let first = k / TILE * SIDE + k % TILE;
            var line = vec4f(0.0);
            for (var d = 0u; d < TAPS; d++) {
                let x = pixels[first + d].x;
                let y = pixels[first + d].y;
                line += window(d) * vec4f(x, y, x * x + y * y, x * y);
            }
            lines[k] = line;
        }
        workgroupBarrier();
        for (var k = lane / TILE; k < TILE; k += LANES / TILE) {
            let inner = (k + REACH) * SIDE + column + REACH;
            let at = index_of(corner, inner);
            if (at >= count) { continue; }
            let m = mean_down(column, k);
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
            slopes[3u * channel * count + at] = by_x;
            slopes[(3u * channel + 1u) * count + at] = by_xx;
            slopes[(3u * channel + 2u) * count + at] = by_xy;
            sum += vec2f(abs(pixels[inner].x - pixels[inner].y), value);
        }
        workgroupBarrier();
    }
    sums[lane] = sum;
    workgroupBarrier();
    if (lane == 0u) {
        sum = vec2f(0.0);
        for (var k = 0u; k < LANES; k++) { sum += sums[k]; }
        parts[group_of(group)] = sum;
    }
}

// Compute the gradient. The window is symmetric, so the derivatives by the means propagate to a value as their windowed
// mean. The derivatives of x, x^2 and xy by x are 1, 2x and y.
@compute @workgroup_size(LANES)
fn differentiate(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let corner = corner_of(group_of(group));
    let count = u.width * u.height;
    let column = lane % TILE;
    var gradients: array<vec4f, 4>;
    for (var channel = 0u; channel < 3u; channel++) {
        for (var k = lane; k < AREA; k += LANES) {
            let at = index_of(corner, k);
            var slope = vec3f(0.0);
            if (at < count) {
                let first = 3u * channel * count + at;
                slope = vec3f(slopes_of[first], slopes_of[first + count], slopes_of[first + 2u * count]);
            }
            pixels[k] = slope.xy;
            third_slopes[k] = slope.z;
        }
        workgroupBarrier();
        for (var k = lane; k < LINES; k += LANES) {
            let first = k / TILE * SIDE + k % TILE;
            var line = vec4f(0.0);
            for (var d = 0u; d < TAPS; d++) {
                line += window(d) * vec4f(pixels[first + d], third_slopes[first + d], 0.0);
            }
            lines[k] = line;
        }
        workgroupBarrier();
        for (var k = 0u; k < 4u; k++) {
            let row = lane / TILE + k * (LANES / TILE);
            let at = index_of(corner, (row + REACH) * SIDE + column + REACH);
            if (at >= count) { continue; }
            let x = drawn[at][channel];
            let y = photo_value(at, channel);
            let through_ssim = dot(mean_down(column, row).xyz, vec3f(1.0, 2.0 * x, y));
            gradients[k][channel] = u.l1_weight * sign(x - y) - u.ssim_weight * through_ssim;
        }
        workgroupBarrier();
    }
    for (var k = 0u; k < 4u; k++) {
        let row = lane / TILE + k * (LANES / TILE);
        let at = index_of(corner, (row + REACH) * SIDE + column + REACH);
        if (at < count) { by_image[at] = gradients[k]; }
    }
}
