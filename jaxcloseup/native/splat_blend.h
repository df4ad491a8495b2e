// Blends an image of splats, and its derivative.
#pragma once

#include "splat_lists.h"

namespace jaxcloseup {

// The functions that suit this processor best.
const Passes& best_passes();

// Blends all of an image.
void blend(xla::ffi::ThreadPool& pool, const Image& image, const Planes& out);

// Pulls cotangents of an image back to rows of its table; only those of listed splats are written.
void pull_back(xla::ffi::ThreadPool& pool, const Image& image, const Listing& listing, const Cotangents& in,
               float* table_bar);

}  // namespace jaxcloseup
